"""Upper bounds of the controller's cost: small parts of cells followed for many steps."""
