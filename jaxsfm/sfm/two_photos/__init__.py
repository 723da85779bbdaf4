"""Matches two photos as well as it can: at other scales, turned, and as seen from one place."""
