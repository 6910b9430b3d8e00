"""Monitors between publishers and subscribers, and between clients and services."""
