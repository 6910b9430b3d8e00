"""Evidence bundles of robots, which operators carry to the collector: verified, stored, listed and returned."""
