"""The configuration: every key with its default, where values come from, and the parts that are installed."""
