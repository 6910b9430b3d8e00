"""ETag and If-Match: a change is for what its author has seen, or it is not made."""

import re
from typing import Annotated

from fastapi import Header

from appliance.api.problems import ProblemError

_TAG = re.compile(r'"([\x21\x23-\x7e]{1,90})"')
_REVISION = re.compile(r"[0-9]{1,18}")

IfMatch = Annotated[
    str | None,
    Header(
        alias="If-Match",
        max_length=100,
        description="The ETag of what the change is meant for, or `*` for whatever is in force.",
    ),
]


def etag(tag: int | str) -> str:
    """The ETag of a revision, or of what has a tag of its own."""
    return f'"{tag}"'


def expected_revision(if_match: str | None, what: str = "policy", where: str = "/v1/policy") -> int | None:
    """The revision that `If-Match` names; None for `*`. Raises `ProblemError` (428, 412).

    `what` is changed, and `where` GET says its ETag.
    """
    tag = expected_tag(if_match, what, where)
    if tag is None:
        return None
    if not _REVISION.fullmatch(tag):
        raise _no_tag(if_match, where)
    return int(tag)


def expected_tag(if_match: str | None, what: str, where: str) -> str | None:
    """The same for what has tags that only who made them understands."""
    if if_match is None:
        raise ProblemError(
            428,
            "precondition-required",
            f"say which {what} you have seen: If-Match with the ETag of GET {where}",
        )
    if if_match.strip() == "*":
        return None
    found = _TAG.fullmatch(if_match.strip())
    if found is None:
        raise _no_tag(if_match, where)
    return found[1]


def _no_tag(if_match: str | None, where: str) -> ProblemError:
    text = f'{(if_match or "")[:80]!r} is no ETag of {where}: give the one that GET answers, as in "7"'
    return ProblemError(412, "changed-meanwhile", text)
