"""Start, watch and restart the processes of the appliance, each with only the privileges it needs."""
