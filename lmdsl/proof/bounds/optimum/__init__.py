"""Lower bounds of the cost of every control law: what controls may do on equal parts of cells."""
