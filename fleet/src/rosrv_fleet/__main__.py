"""Run the command `rosrv-fleet`."""

from rosrv_fleet.cli import main

main()
