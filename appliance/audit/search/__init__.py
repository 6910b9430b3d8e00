"""Read the audit log: filters, pages, summaries and explanations."""
