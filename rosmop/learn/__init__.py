"""Learn monitors from recordings of normal operation: regular behaviour, written as specifications."""
