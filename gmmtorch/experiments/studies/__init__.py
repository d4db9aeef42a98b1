"""One file for each figure, table or comparison of the thesis."""
