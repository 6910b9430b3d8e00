"""Formats that the appliance writes and the collector reads, and the other way round."""
