"""Learn monitors from recordings of normal operation, and write the observed regularities as specifications."""
