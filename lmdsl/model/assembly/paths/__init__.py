"""Steps judged on the way: where a sample first enters the attractor, avoid or the outside."""
