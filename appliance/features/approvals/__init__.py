"""Approvals: an operator permits calls of hosts that the policy lists after `ask`, once or for some time."""
