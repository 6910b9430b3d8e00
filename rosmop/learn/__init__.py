"""Learn monitors from recordings of normal operation."""
