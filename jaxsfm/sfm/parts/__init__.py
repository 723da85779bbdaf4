"""It adjusts a long row of photos in parts that overlap, whose frames are then found together."""
