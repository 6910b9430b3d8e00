"""Approvals: an operator permits calls that the policy lists behind `ask`, once or for some time."""
