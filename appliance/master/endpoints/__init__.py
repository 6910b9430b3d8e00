"""The endpoints of nodes: proxies, ports, addresses, and relays."""
