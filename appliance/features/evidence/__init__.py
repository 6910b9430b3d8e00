"""Signed bundles of the log, policies and recordings of an incident, made and sealed."""
