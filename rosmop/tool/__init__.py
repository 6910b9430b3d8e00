"""The command `rosmop`, shared with `rosrv monitor`: the only part of the language that reads and writes files."""
