"""Doors: browsers, Foxglove and agents reach the robot, each with the rights of its own host."""
