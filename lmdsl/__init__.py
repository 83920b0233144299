"""lmdsl."""
