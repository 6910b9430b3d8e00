"""Features: each folder has all that one feature adds, and `table.py` lists them."""
