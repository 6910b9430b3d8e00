"""`rosrv monitor`: specifications judged, tried and switched."""
