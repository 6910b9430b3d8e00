"""Limits: how much of each finite resource is used."""
