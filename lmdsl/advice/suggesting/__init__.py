"""Step, cells and samples that fit each other, found by trials on a small scale."""
