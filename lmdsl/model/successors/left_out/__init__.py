"""Pairs that are left out of a model: which must be, and what a model without them is."""
