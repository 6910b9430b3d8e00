"""The `rosrv` command."""
