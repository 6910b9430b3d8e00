"""`rosrv audit`: review the audit log."""
