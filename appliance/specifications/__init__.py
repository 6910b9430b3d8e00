"""The specifications in force: compiled, stored, sent to the relays."""
