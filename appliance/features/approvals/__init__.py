"""Approvals: an operator lets a host that the policy lists behind `ask` through, once or for some time."""
