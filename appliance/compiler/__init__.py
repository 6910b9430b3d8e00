"""The compiler: parses specifications for control in a process without any other access."""
