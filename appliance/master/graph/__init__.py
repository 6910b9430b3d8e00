"""The graph: nodes, registrations, updates for subscribers, and the effects of a change of the policy."""
