"""Features: each folder has everything that one feature adds, and `table.py` lists them."""
