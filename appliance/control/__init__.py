"""The control process: it decides requests, holds the state, and answers operators."""
