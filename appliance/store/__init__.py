"""Durable state of control in SQLite: registry, parameters, policy revisions, settings."""
