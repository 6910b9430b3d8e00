"""Live: the state of the appliance, its last hour and the token's holder, for the console."""
