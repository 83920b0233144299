"""What plots are made of: views of the cells, runs of the system, and layers of ink."""
