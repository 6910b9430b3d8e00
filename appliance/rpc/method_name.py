"""Find the method name in a request that cannot be parsed, for the request's audit record. No I/O."""

import re

_BEGINNING = 4096  # the number of bytes that are searched
_METHOD = re.compile(rb"<methodName>\s*+([^<>&\s]{1,128}+)\s*+</methodName>")


def method_named(body: bytes) -> str:
    found = _METHOD.search(body, 0, _BEGINNING)
    return "" if found is None else found[1].decode("utf-8", "replace")
