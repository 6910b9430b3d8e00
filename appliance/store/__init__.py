"""Durable state of control in SQLite: registry, parameters, policy revisions, settings.

`Database` is the one writer thread; the modules of the tables list what is stored. The audit log has its own file.
"""
