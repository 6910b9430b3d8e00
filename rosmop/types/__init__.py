"""The types of the ``.rv`` language, their conversions, and their relation to message definitions."""
