"""Evidence: signed bundles of the log, the policies and the recordings of an incident."""
