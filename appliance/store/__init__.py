"""Durable state of control in SQLite: registry, parameters, policy revisions, settings.

`Database` has the only writer thread. The modules `state_file` and `host_tables` define the tables. The audit log has
its own file.
"""
