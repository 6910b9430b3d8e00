"""The witness of two appliances, a program for the robot's computer (`program.py`)."""
