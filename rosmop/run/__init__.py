"""Run specifications, without I/O or a clock."""
