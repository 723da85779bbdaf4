"""Says what a finished run holds."""
