"""Models in metres: GPS, tables of positions and ground control points."""
