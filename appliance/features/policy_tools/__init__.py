"""Check, explain, test, compare, grant and learn policies; most of it also without a running appliance."""
