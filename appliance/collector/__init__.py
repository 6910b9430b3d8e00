"""The connection to a fleet's collector, for the processes that push segments and poll for bundles."""
