"""Process many recordings, one job each, on this machine or on a cluster; the results are the same."""
