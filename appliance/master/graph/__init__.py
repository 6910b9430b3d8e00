"""The graph: nodes, registrations, grants, updates for subscribers, and the effects of a new policy."""
