"""Show errors of the system to people, without the numbers."""

import re


def without_number(error: Exception) -> str:
    """Return the text without the number that libraries put before it: `[Errno 111] Connection refused`."""
    return re.sub(r"\[Errno -?\d{1,4}\] ", "", str(error))
