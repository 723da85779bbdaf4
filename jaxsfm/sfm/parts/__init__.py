"""It maps many photos in parts that overlap, and makes one model of the models of the parts."""
