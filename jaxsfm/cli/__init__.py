"""Turns arguments into calls."""
