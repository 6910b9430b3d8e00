"""`rosrv demo`: the product at work."""
