"""Whether the keys of a problem fit together: names, formulas, sets, and what ends a run."""
