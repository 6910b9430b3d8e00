"""Receive the calls of REST: connections, limits, tokens, the link to control, and what every route uses."""
