"""The demonstration: a simulated robot, its operator and an attacker, on this machine."""
