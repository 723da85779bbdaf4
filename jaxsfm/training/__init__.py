"""Learns relocalizers: the parameters of `jaxsfm.core.scores.Scores`, from photos."""
