"""`rosrv policy`: a policy judged, learnt and loaded."""
