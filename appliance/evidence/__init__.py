"""Evidence bundles: the audit records of a period in one file that can be verified anywhere."""
