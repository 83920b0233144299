"""Result directories: what they hold, written and read as one, and compared with what is true."""
