"""The address of the appliance's own node (rosout), for control and the firewall.

The node serves its API on every address. Control calls it at a loopback address that only control may connect to; the
firewall blocks it everywhere else (`appliance/network/firewall/firewall_rules.py`).
"""

ADDRESS = "127.87.79.1"
