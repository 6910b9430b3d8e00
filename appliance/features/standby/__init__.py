"""Two appliances, of which the robot admits one, by a lease that the robot's own computer holds."""
