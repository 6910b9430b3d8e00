"""Push sealed segments of the audit log to a collector, and take its signed bundles."""
