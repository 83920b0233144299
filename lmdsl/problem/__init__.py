"""What a user declares: one model per key of a problem file."""
