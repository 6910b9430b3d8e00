"""What keeps the graph and the world alike: effects carried out, and what is done without being asked."""
