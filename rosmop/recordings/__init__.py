"""Read recordings (bags and MCAP files), and run monitors on them."""
