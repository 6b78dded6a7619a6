"""Studies as grids of cells, and the folder in which cells are made once, whatever is killed."""
