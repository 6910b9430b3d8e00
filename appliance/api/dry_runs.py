"""Dry runs: what a change would do, without making it."""

from typing import Annotated

from fastapi import Query

DryRun = Annotated[bool, Query(description="only say what it would do; for operators, without If-Match")]
_NO = frozenset({b"", b"0", b"false", b"off", b"no", b"f", b"n"})


def is_dry(query: bytes) -> bool:
    """Whether a request is a dry run, by its query."""
    found = [
        value
        for name, _eq, value in (part.partition(b"=") for part in query.split(b"&"))
        if name == b"dry_run"
    ]
    return bool(found) and found[-1].lower() not in _NO
