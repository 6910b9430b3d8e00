"""The command `rosmop`, which `rosrv monitor` shares."""
