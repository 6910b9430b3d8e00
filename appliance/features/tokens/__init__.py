"""Access tokens: `rosrv token`. Control keeps the tokens (`control/operators/token_orders.py`)."""
