"""The flight recorder: the latest messages, in memory that outlives the relays, and recordings of them."""
