"""The connection to a running appliance: its admin socket, or REST."""
