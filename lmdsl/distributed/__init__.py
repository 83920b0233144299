"""The verbs over ranks, and what they return: facts that all share, arrays of own cells."""
