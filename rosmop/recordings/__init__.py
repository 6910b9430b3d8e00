"""Read recordings: bags and MCAP files, one message after the other, and run monitors on them."""
