"""The chain of a policy over ranks: gathered on rank 0, or peeled and swept by all."""
