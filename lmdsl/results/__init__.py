"""The verbs, and what they return: solve, verify, compare; results and their directories."""
