"""Rollouts bring signed bundles to robots, in rings that open only while the robots stay healthy."""
