"""Audit records and metrics of the control process."""
