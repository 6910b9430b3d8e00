"""Tools for policies: check, explain, test, compare, grant and learn them, besides the running appliance."""
