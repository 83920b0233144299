"""Deciding boxes: rounds of looking at them, which to bisect, which stay, bounds of their cost."""
