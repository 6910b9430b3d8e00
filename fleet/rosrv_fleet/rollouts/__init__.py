"""Rollouts: which robot gets which signed bundle, in rings that advance only while the robots stay healthy."""
