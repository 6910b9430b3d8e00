"""Where the appliance's own node (rosout) is called: what control and the firewall agree on.

It serves its API on every address. Control calls it at one of loopback's that nobody else may connect to, and it
answers nobody at any other (`appliance/network/firewall/firewall_rules.py`).
"""

ADDRESS = "127.87.79.1"
