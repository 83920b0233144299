"""What looks wrong with a problem, and what it takes, before the long run."""
