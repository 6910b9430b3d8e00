"""Network namespaces, the firewall, and the ports of machines with nodes."""
