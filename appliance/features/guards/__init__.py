"""Presets of specifications that stop a robot, and the commands that bring them into force."""
