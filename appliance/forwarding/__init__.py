"""Forward the audit log to a syslog receiver, from a process that can only read it."""
