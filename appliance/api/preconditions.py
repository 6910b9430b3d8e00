"""ETag and If-Match: a change is for the revision its author has seen, or it is not made."""

import re
from typing import Annotated

from fastapi import Header

from appliance.api.problems import ProblemError

_TAG = re.compile(r'"([0-9]{1,18})"')

IfMatch = Annotated[
    str | None,
    Header(
        alias="If-Match",
        max_length=100,
        description="The ETag of the policy the change is meant for, or `*` for whichever is in force.",
    ),
]


def etag(revision: int) -> str:
    """The ETag of a revision."""
    return f'"{revision}"'


def expected_revision(if_match: str | None) -> int | None:
    """The revision that `If-Match` names; None for `*`. Raises `ProblemError` (428, 412)."""
    if if_match is None:
        raise ProblemError(
            428,
            "precondition-required",
            "say which policy you have seen: If-Match with the ETag of GET /v1/policy",
        )
    if if_match.strip() == "*":
        return None
    found = _TAG.fullmatch(if_match.strip())
    if found is None:
        raise ProblemError(412, "changed-meanwhile", f'{if_match[:80]!r} is no ETag of a policy, such as "7"')
    return int(found[1])
