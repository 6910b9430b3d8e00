"""The appliance's firewall: one list of rules, two back ends, and the proof that the kernel enforces them."""
