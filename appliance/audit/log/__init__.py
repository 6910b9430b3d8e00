"""Write the audit log: records, their chain, the files, and what is removed from them."""
