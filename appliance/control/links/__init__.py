"""Connect control to the supervisor and the signer."""
