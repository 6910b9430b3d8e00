"""The address of the appliance's own node (rosout), for control and the firewall.

The node serves its API on every address of its machine. Control calls the API at a loopback address to which only
control may connect. The firewall blocks all other access (`appliance/network/firewall/firewall_rules.py`).
"""

ADDRESS = "127.87.79.1"
