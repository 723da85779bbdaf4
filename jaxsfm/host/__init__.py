"""The shell around the core: files, OpenCV, pycolmap."""
