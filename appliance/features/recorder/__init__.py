"""The flight recorder: keeps the latest messages in memory that outlives the relays, and makes recordings of them."""
