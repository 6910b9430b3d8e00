"""Dry runs: what a change would do, without making it."""

_NO = frozenset({b"", b"0", b"false", b"off", b"no", b"f", b"n"})
_QUESTIONS = frozenset({"/v1/policy/explain", "/v1/policy/test"})


def is_dry(path: str, query: bytes) -> bool:
    """Whether a request changes nothing, whatever its method says: by its query, or as a question with a body."""
    if path in _QUESTIONS:
        return True
    found = [
        value
        for name, _eq, value in (part.partition(b"=") for part in query.split(b"&"))
        if name == b"dry_run"
    ]
    return bool(found) and found[-1].lower() not in _NO
