"""Why cells cannot be stabilized, and what would help."""
