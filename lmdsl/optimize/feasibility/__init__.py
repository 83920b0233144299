"""Whether a policy is stabilizing at a gamma, and the largest gamma of which one is."""
