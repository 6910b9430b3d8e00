"""`rosrv audit`: the review of the audit log."""
