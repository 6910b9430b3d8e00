"""Parts of control that its links and operators use."""
