"""Pure JAX functions: no files, clocks, prints, OpenCV or COLMAP (import-linter holds this)."""
