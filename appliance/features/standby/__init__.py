"""TODO: appliance/features/standby."""
