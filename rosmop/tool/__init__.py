"""The command `rosmop`, shared with `rosrv monitor`: only this part of the language reads and writes files."""
