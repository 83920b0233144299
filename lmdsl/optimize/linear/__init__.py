"""x = b + M x for the rows of a policy: sweeps, substitution, extrapolation, Krylov, classes."""
