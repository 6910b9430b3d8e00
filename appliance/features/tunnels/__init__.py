"""Tunnels: the process that runs charon, and the commands that enrol hosts."""
