"""TODO: appliance/features/recorder."""
