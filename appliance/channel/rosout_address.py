"""The address of the appliance's own node (rosout), for control and the firewall.

The node serves its API on every address. Control calls it at this loopback address, which only control may use.
"""

ADDRESS = "127.87.79.1"
