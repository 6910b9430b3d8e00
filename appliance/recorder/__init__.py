"""The flight recorder: what the relays carried last, in memory that outlives them, and recordings made of it."""
