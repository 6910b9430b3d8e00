"""A world in one process: the product's own control on a simulated network, in virtual time."""
