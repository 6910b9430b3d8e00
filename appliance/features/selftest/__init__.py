"""`rosrv selftest`: check this machine, its files and the running appliance."""
