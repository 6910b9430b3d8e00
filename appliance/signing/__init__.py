"""Keys and signatures: signed requests, site keys, signed statements, fingerprints."""
