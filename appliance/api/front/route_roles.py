"""Require roles for routes, and convert control's rejections to problems."""

from typing import Annotated, Any

from fastapi import Depends, Request, Security
from fastapi.security import HTTPBearer

from appliance.api.front.access import Bearer
from appliance.api.front.control import ControlAwayError, ControlLink
from appliance.api.front.problems import ProblemError
from appliance.api.front.request_gate import BEARER
from appliance.channel.admin import A, AdminAnswer, AdminRequest, Trouble
from appliance.channel.answers.token_answers import TokenRole, may

_SCHEME = HTTPBearer(auto_error=False, description="A token made by `rosrv token add`")


class _Requires:
    """Returns the bearer, who must have at least the role `least`.

    Each dependency is asynchronous, because FastAPI calls others in a thread for every request.
    """

    def __init__(self, least: TokenRole) -> None:
        self.least = least

    async def __call__(self, request: Request, _token: Annotated[object, Security(_SCHEME)]) -> Bearer:
        bearer: Bearer = request.scope[BEARER]
        if not may(bearer.role, self.least):
            text = f"this is for {self.least}s; the token {bearer.name} has the role {bearer.role}"
            raise problem_of("forbidden", text)
        return bearer


def requires(least: TokenRole) -> Any:
    return Depends(_Requires(least))


VIEWER = requires("viewer")
"""The value for `dependencies=` of a route that does not use the bearer."""

OPERATOR = requires("operator")
Viewer = Annotated[Bearer, VIEWER]
Investigator = Annotated[Bearer, requires("investigator")]
Operator = Annotated[Bearer, OPERATOR]
Admin = Annotated[Bearer, requires("admin")]


def reads_contents(bearer: Bearer) -> bool:
    return bearer.role != "viewer"


async def _no_viewer(bearer: Viewer) -> Bearer:
    if not reads_contents(bearer):
        text = f"this is for investigators, operators and admins; the token {bearer.name} is a viewer's"
        raise problem_of("forbidden", text)
    return bearer


Reader = Annotated[Bearer, Depends(_no_viewer)]
"""The bearers who may read messages in records: investigators, operators and admins."""

_PROBLEMS = {
    "request": (422, "bad-input"),
    "refused": (422, "refused"),
    "conflict": (412, "changed-meanwhile"),
    "unknown": (404, "unknown"),
    "forbidden": (403, "not-for-this-role"),
    "busy": (503, "busy"),
    "failed": (503, "not-available"),
}
_PASSIVE_SECONDS = 2  # until a client may ask a standby again


async def ask(control: ControlLink, request: AdminRequest[A], bearer: Bearer) -> A:
    """Return control's answer. Raises `ProblemError` for a rejection, `ControlAwayError` without an answer."""
    return unwrap(await control.ask(request, bearer))


async def ask_optional(control: ControlLink, request: AdminRequest[A], bearer: Bearer) -> A | None:
    """Return control's answer, or None after a rejection, such as a standby's, or without an answer."""
    try:
        return await ask(control, request, bearer)
    except (ControlAwayError, ProblemError):
        return None


def unwrap(answer: AdminAnswer[A]) -> A:
    """Return what control's answer contains. Raises `ProblemError` for a rejection."""
    if answer.ok:
        return answer.unwrap()
    if answer.trouble == "standby":
        raise only_passive(answer.error, answer.active)
    raise problem_of(answer.trouble, "\n".join([answer.error, *answer.findings]))


def problem_of(trouble: Trouble, detail: str) -> ProblemError:
    status, kind = _PROBLEMS.get(trouble, (503, "not-available"))
    return ProblemError(status, kind, detail)


def only_passive(detail: str, active: str) -> ProblemError:
    return ProblemError(503, "standby", detail, retry_after=_PASSIVE_SECONDS, active=active)
