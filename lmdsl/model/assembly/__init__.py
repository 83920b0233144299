"""Ulam's method: the map and the cost at the samples of every cell, merged into transition rows."""
