"""Alarms: operators list, acknowledge and silence them."""
