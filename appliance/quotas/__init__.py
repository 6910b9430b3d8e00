"""Quotas on finite resources: `pool` counts the holdings of hosts, `table` lists all counted resources."""
