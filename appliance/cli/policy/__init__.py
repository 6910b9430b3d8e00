"""`rosrv policy`: check, test, learn and load policies."""
