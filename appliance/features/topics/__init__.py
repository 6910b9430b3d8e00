"""Topics and nodes of the running robot on the command line."""
