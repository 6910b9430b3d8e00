"""Metrics: the route for Prometheus."""
