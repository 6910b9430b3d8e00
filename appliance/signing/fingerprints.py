"""Hash policies and specifications when they take effect, so that the audit log identifies them.

The hash of several texts is that of the lines that `sha256sum` prints for their files, sorted by name.
"""

import hashlib
from collections.abc import Mapping
from urllib.parse import quote


def fingerprint(text: str | bytes) -> str:
    return hashlib.sha256(text.encode() if isinstance(text, str) else text).hexdigest()


def fingerprint_of_all(texts: Mapping[str, str]) -> str:
    lines = sorted((file_name(name), fingerprint(text)) for name, text in texts.items())
    return fingerprint("".join(f"{digest}  {name}\n" for name, digest in lines))


def file_name(name: str) -> str:
    """Encode unusual characters with percent signs."""
    parts = name.split("/")
    return "/".join(quote(part) if part.strip(".") else part.replace(".", "%2E") or "%" for part in parts)
