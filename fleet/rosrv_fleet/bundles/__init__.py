"""Bundles: the operator's repository with its offline keys, and what the collector publishes of it."""
