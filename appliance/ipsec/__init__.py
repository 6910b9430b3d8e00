"""The signer, which holds the keys; certificates and tunnels come to it."""
