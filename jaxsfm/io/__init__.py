"""Our own files: images, weights, features and matches, the work folder."""
