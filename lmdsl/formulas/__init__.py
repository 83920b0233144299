"""Text formulas: read, evaluated, enclosed, traced."""
