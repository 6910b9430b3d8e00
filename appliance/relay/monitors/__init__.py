"""Specifications in the middle of topics and services."""
