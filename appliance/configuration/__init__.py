"""The configuration: all keys with their defaults, the sources of values, and the installed parts."""
