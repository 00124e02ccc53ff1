"""How good a learned map is: scores of cells and of planned paths against the true map."""
