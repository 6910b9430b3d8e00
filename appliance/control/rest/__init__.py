"""Answer the requests of REST, and check the proofs of signed orders."""
