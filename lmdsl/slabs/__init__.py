"""The model over ranks: each compiles, improves and judges the pairs of its own cells."""
