"""Process many recordings: one job each, on this machine or on a cluster, with results that do not depend on where."""
