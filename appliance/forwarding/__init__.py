"""Sends the audit log on to a syslog receiver, from a process of its own that can only read it."""
