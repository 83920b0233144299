"""Finite models: rows that are given as matrices, and not sampled from a map."""
