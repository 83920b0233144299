"""Functions of the user's own: how they are called, what they may return, whether they are pure."""
