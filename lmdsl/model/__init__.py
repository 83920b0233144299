"""What a problem becomes: cells, sets, rows, the stabilizable set, the linear program."""
