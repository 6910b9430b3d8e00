"""Forward the audit log to a syslog receiver, in a process of its own."""
