"""Monitors out of recordings of a robot that behaves: what is regular in them, written as specifications."""
