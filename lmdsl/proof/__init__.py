"""What holds for the true map, by volume: boxes, their images, and what becomes of them."""
