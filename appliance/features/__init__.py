"""Features: folders that the core does not know."""
