"""Parts of control that stand below its links and operators."""
