"""Evidence bundles: what happened in a span of time in one file that proves itself elsewhere."""
