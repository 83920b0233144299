"""Our algorithms on the model: they make policies and vectors, and claim nothing."""
