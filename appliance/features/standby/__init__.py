"""Two appliances, of which the robot admits one, by a lease on the robot's own computer."""
