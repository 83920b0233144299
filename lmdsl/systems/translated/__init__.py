"""Systems of other tools, translated to formulas where the language allows."""
