"""Connections of publishers, subscribers, clients and services."""
