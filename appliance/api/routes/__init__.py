"""Answer the calls of REST: the routes, and the contract that describes them."""
