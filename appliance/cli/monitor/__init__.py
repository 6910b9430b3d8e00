"""`rosrv monitor`: check, try, load and switch specifications."""
