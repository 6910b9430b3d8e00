"""Bundles: the operator's repository, signed with offline keys, and its publication by the collector."""
