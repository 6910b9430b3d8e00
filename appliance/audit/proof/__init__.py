"""Prove and verify the audit log: checkpoints, copies, excerpts with proofs, segments."""
