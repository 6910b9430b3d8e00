"""Hash policies and specifications when they take effect, so that the audit log identifies them.

The hash of several texts is the hash of the lines that `sha256sum` prints for their files, sorted by name. So anyone
can compute this hash with `sha256sum` alone.
"""

import hashlib
from collections.abc import Mapping
from urllib.parse import quote


def fingerprint(text: str | bytes) -> str:
    """Return the SHA-256 of a text or bytes, in hexadecimal."""
    return hashlib.sha256(text.encode() if isinstance(text, str) else text).hexdigest()


def fingerprint_of_all(texts: Mapping[str, str]) -> str:
    """Return the SHA-256 of named texts; a changed name or text changes the hash."""
    lines = sorted((file_name(name), fingerprint(text)) for name, text in texts.items())
    return fingerprint("".join(f"{digest}  {name}\n" for name, digest in lines))


def file_name(name: str) -> str:
    """Convert a name to a relative file path, with unusual characters percent-encoded."""
    parts = name.split("/")
    return "/".join(quote(part) if part.strip(".") else part.replace(".", "%2E") or "%" for part in parts)
