"""Namespaces, the firewall, and the ports of the machine that the nodes run on."""
