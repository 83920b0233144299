"""A problem in many variants: cells, samples, step, gamma and backends in turn."""
