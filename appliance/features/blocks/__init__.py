"""Blocks: hosts that operators block during an incident."""
