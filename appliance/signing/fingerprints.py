"""What the audit log has of the texts that came into force: hashes by which they are known again.

The hash of several texts is that of the lines that `sha256sum` prints for their files, in the order of their names:
whoever has the files can make it with `sha256sum` alone.
"""

import hashlib
from collections.abc import Mapping
from urllib.parse import quote


def fingerprint(text: str | bytes) -> str:
    """SHA-256 of a text, or of bytes, in hexadecimal."""
    return hashlib.sha256(text.encode() if isinstance(text, str) else text).hexdigest()


def fingerprint_of_all(texts: Mapping[str, str]) -> str:
    """SHA-256 of named texts: no other names or texts have the same."""
    lines = sorted((file_name(name), fingerprint(text)) for name, text in texts.items())
    return fingerprint("".join(f"{digest}  {name}\n" for name, digest in lines))


def file_name(name: str) -> str:
    """A name as that of a file below a folder, whatever is in it: what is unusual in a path is percent-encoded."""
    parts = name.split("/")
    return "/".join(quote(part) if part.strip(".") else part.replace(".", "%2E") or "%" for part in parts)
