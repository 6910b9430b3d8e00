"""The audit log: a record of every event, in a hash chain with signed checkpoints."""
