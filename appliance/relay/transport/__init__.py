"""Sockets, frames, memory and rate limits of one relay, without topics and services."""
