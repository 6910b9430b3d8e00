"""Show errors of the system to people, who do not know their numbers."""

import re


def without_number(error: Exception) -> str:
    """Libraries put a number before the text of a system's error: `[Errno 111] Connection refused`."""
    return re.sub(r"\[Errno -?\d{1,4}\] ", "", str(error))
