"""Training of learned relocalizers: photos in, parameters of `jaxsfm.core.scores.Scores` out."""
