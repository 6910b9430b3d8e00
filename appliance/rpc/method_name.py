"""The method that a request names, by its bytes: for the record of one that cannot be read as a whole. No I/O."""

import re

_BEGINNING = 4096  # bytes of a body that are looked at
_METHOD = re.compile(rb"<methodName>\s*([^<>&\s]{1,128})\s*</methodName>")


def method_named(body: bytes) -> str:
    """The method's name as it stands in the beginning of a body; empty where none does."""
    found = _METHOD.search(body, 0, _BEGINNING)
    return "" if found is None else found[1].decode("utf-8", "replace")
