"""The machine we run on: compiled kernels, threads, forks, memory, deadlines, foreign output."""
