"""Proofs and simulated worlds of the products; no product imports them."""
