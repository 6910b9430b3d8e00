"""Starts, watches and restarts the processes of the appliance, each with the privileges it needs."""
