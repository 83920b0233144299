"""Enclosures as compiled loops: formulas become tapes of interval operations on blocks of boxes."""
