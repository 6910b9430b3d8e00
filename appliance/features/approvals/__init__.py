"""An operator permits calls of hosts that the policy lists behind `ask`, once or for some time."""
