"""Evidence bundles of robots: operators add them, and the collector verifies, stores, lists and returns them."""
