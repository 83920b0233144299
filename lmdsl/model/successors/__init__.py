"""Which cells the image of a whole cell can meet: enclosures, and what survives them."""
