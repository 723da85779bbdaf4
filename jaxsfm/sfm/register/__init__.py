"""Adds photos to a finished model."""
