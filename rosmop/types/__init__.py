"""The types of the ``.rv`` language, how they convert, and how they meet the definitions of messages."""
