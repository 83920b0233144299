"""The pairs of own cells, over ranks: which survive, and the levels that they form."""
