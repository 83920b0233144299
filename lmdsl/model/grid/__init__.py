"""The cells of the box: axes, where a state lies, sets of cells as boxes, orders of visiting."""
