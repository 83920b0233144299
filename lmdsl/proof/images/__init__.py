"""The boxes of a cover, and their images under a controller."""
