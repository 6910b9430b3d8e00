"""Evidence bundles: the audit records of a span of time in one file that can be verified anywhere."""
