"""The graph: who is who, who registered what, who is told, and what a change of the policy ends."""
