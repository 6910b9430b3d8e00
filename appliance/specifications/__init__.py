"""The specifications of monitors in force: checked, kept, given to the relays."""
