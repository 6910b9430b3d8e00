"""The bundles of a fleet: their archive, their signed terms, and the process that polls a collector for them."""
