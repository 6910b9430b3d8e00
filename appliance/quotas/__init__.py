"""Quotas on finite resources: one way of counting (`pool`), one table of the counted resources (`table`)."""
