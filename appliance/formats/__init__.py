"""Define the formats of files and messages between the appliance and the collector."""
