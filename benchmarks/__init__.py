"""Benchmarks: lmdsl and its rivals on the same models in the same run. See README.md."""
