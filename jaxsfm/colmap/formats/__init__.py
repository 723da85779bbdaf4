"""Other tools' files: one small module each, in that tool's own conventions."""
