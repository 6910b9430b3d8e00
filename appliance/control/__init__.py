"""The control process. It decides requests, stores the state, and answers operators."""
