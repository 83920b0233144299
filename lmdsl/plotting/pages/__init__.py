"""Whole pages: all pictures of a result, one quantity in many panels, and moving ones."""
