"""What a route asks of who calls it: a role, and what every other route asks the same way."""

from typing import Annotated, Any

from fastapi import Depends, Request, Security
from fastapi.security import HTTPBearer

from appliance.api.access import Bearer
from appliance.api.control import ControlLink
from appliance.api.problems import ProblemError
from appliance.api.request_gate import BEARER
from appliance.api.routing import Routes
from appliance.channel.admin import A, AdminAnswer, AdminRequest, Trouble, answer_to, operation_of
from appliance.channel.answers.token_answers import TokenRole, may

_SCHEME = HTTPBearer(auto_error=False, description="A token made by `rosrv token add`")


class _Requires:
    """A dependency: the bearer, whose role must be at least this one."""

    def __init__(self, least: TokenRole) -> None:
        self.least = least

    def __call__(self, request: Request, _token: Annotated[Any, Security(_SCHEME)]) -> Bearer:
        bearer: Bearer = request.scope[BEARER]
        if not may(bearer.role, self.least):
            text = f"this is for {self.least}s; the token {bearer.name} has the role {bearer.role}"
            raise problem_of("forbidden", text)
        return bearer


VIEWER = Depends(_Requires("viewer"))
"""For `dependencies=` of a route that asks for the role and nothing more of who calls."""

OPERATOR = Depends(_Requires("operator"))
Viewer = Annotated[Bearer, VIEWER]
Investigator = Annotated[Bearer, Depends(_Requires("investigator"))]
Operator = Annotated[Bearer, OPERATOR]
Admin = Annotated[Bearer, Depends(_Requires("admin"))]


def reads_contents(bearer: Bearer) -> bool:
    """Whether who calls may read what single messages said in the records of monitors: all but viewers."""
    return bearer.role != "viewer"


def _no_viewer(bearer: Viewer) -> Bearer:
    if not reads_contents(bearer):
        text = f"this is for investigators, operators and admins; the token {bearer.name} is a viewer's"
        raise problem_of("forbidden", text)
    return bearer


Reader = Annotated[Bearer, Depends(_no_viewer)]
"""Whoever may read what messages said in records: investigators, operators and admins."""

_PROBLEMS = {
    "request": (422, "bad-input"),
    "refused": (422, "refused"),
    "conflict": (412, "changed-meanwhile"),
    "unknown": (404, "unknown"),
    "forbidden": (403, "not-for-this-role"),
    "busy": (503, "busy"),
    "failed": (503, "not-available"),
}


async def ask(control: ControlLink, request: AdminRequest[A], bearer: Bearer) -> A:
    """Control's answer. Raises `ProblemError` for a refusal, `ControlAwayError` when there is no control."""
    return answered(await control.ask(request, bearer))


_LEAST: dict[str, Any] = {
    "viewer": Viewer,
    "investigator": Investigator,
    "operator": Operator,
    "admin": Admin,
}


def add_look(routes: Routes, control: ControlLink, question: type[AdminRequest[Any]]) -> None:
    """Add the route of a question that has no fields: its path, role, answer and words are those of the request."""
    operation = operation_of(question())
    assert operation is not None  # noqa: S101  it has `@rest`
    path = operation.path.removeprefix(routes.prefix)

    async def look(bearer: Bearer) -> Any:
        return await ask(control, question(), bearer)

    look.__doc__ = question.__doc__
    look.__name__ = operation.path.rpartition("/")[2]
    look.__annotations__ = {"bearer": _LEAST[operation.role or ""], "return": answer_to(question)}
    routes.add_api_route(path, look, operation_id=operation.path.removeprefix("/v1/").replace("/", "_"))


def answered(answer: AdminAnswer[A]) -> A:
    """The body of an answer. Raises `ProblemError` for a refusal."""
    if answer.ok:
        return answer.given()
    raise problem_of(answer.trouble, "\n".join([answer.error, *answer.findings]))


def problem_of(trouble: Trouble, detail: str) -> ProblemError:
    """How a refusal is answered."""
    status, kind = _PROBLEMS.get(trouble, (503, "not-available"))
    return ProblemError(status, kind, detail)
