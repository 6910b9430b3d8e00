"""The appliance's firewall: a list of rules, two back ends, and a test that the kernel enforces the rules."""
