"""Code that every package may use: files, clocks, input checks. It imports nothing of the appliance."""
