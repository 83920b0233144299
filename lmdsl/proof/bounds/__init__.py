"""Bounds of costs: of boxes that arrive, of parts that are followed, of every law."""
