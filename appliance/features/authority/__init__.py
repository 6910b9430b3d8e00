"""Command authority: one host at a time commands a group of topics and services."""
