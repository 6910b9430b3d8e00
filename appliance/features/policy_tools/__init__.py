"""Check, explain, test, compare, grant and learn policies, besides the running appliance."""
