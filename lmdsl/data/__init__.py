"""Recorded transitions: read, binned into rows, and how sure their probabilities are."""
