"""The command `rosmop`, and what `rosrv monitor` shares with it. Only this part of the language reads and writes."""
