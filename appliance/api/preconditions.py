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
        description="The ETag of what the change is meant for, or `*` for whatever is in force.",
    ),
]


def etag(revision: int) -> str:
    """The ETag of a revision."""
    return f'"{revision}"'


def expected_revision(if_match: str | None, what: str = "policy", where: str = "/v1/policy") -> int | None:
    """The revision that `If-Match` names; None for `*`. Raises `ProblemError` (428, 412).

    `what` is changed, and `where` GET says its ETag.
    """
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
        raise ProblemError(412, "changed-meanwhile", f'{if_match[:80]!r} is no ETag of {where}, such as "7"')
    return int(found[1])
