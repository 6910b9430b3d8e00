"""`rosrv selftest`: whether this machine, its files and the running appliance are in order."""
