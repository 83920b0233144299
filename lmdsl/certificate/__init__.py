"""The judge: model and vectors in, yes or no out; it knows no solver and nothing of the judged."""
