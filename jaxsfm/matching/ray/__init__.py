"""Features and matches from workers on a Ray cluster."""
