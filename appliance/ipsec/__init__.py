"""The signer with its keys, certificates, and the IPsec tunnels."""
