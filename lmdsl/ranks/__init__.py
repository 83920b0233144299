"""Which process owns which cells, and how they talk: alone, as threads, under MPI."""
