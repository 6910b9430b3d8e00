"""Durable state of control in SQLite: registry, parameters, policy revisions, settings.

`Database` is the one writer thread; the tables' modules say what is kept. The audit log has a file of its own.
"""
