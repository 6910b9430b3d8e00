"""The endpoints of nodes: proxies, ports, addresses, and the relays that carry their topics."""
