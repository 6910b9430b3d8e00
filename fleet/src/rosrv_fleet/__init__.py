"""The collector: it stores, proves and searches the audit logs of many appliances."""
