"""`rosrv host`: manage the hosts with a tunnel."""
