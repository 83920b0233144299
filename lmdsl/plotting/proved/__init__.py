"""What is proved of the true map, drawn."""
