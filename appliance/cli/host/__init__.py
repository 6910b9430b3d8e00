"""`rosrv host`: who may come through a tunnel."""
