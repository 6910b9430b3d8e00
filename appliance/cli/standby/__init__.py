"""`rosrv standby`: two appliances, of which one stands by."""
