"""The flight recorder: keep the latest messages in memory that outlives the relays, and make recordings of them."""
