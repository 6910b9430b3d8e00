"""Print who changed which safety setting of the machine, and who drove it, from the audit log."""
