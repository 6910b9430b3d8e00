"""How nodes are reached: faces, ports, addresses, and the relays that carry their topics."""
