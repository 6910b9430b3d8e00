"""The audit log: one record for everything that happens, in a hash chain with signed checkpoints."""
