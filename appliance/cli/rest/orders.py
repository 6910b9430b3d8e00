"""What operators' tools ask, as calls of REST; the answers are those of the admin socket."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, cast
from urllib.parse import quote

import msgspec

from appliance.channel import admin
from appliance.channel.admin import PARAMETERS, A, AdminAnswer, AdminRequest, Operation, Trouble, operation_of
from appliance.channel.answers.graph_answers import Graph, Registration, Registrations
from appliance.cli.admin_client import NotRunningError, encoded
from appliance.cli.rest.session import ProblemError, RestClient

if TYPE_CHECKING:
    from appliance.cli.audit.log_over_rest import RestLog


class RestWay:
    """The appliance at a URL: the same questions and answers as over its socket."""

    def __init__(self, url: str, token: str | None, authority: Path | None) -> None:
        """Raises ValueError when it is no place to send a token to."""
        self.client = RestClient(url, token, authority)

    def ask(self, request: AdminRequest[A]) -> AdminAnswer[A]:
        """Ask one thing. Raises `NotRunningError`."""
        encoded(request)  # what cannot be written over the socket is not asked here either
        try:
            return AdminAnswer(True, _carry_out(self.client, request))
        except ProblemError as problem:
            trouble: Trouble = "unknown" if problem.status == 404 else ""
            return AdminAnswer(False, error=problem.lines[0], findings=problem.lines[1:], trouble=trouble)

    def audit(self) -> "RestLog":
        """Its audit log."""
        from appliance.cli.audit.log_over_rest import RestLog  # noqa: PLC0415  only for the verbs that read it

        return RestLog(self.client)


def _carry_out(rest: RestClient, request: AdminRequest[A]) -> A:
    """Ask over REST. Raises `NotRunningError` for what is not asked there."""
    asked: Any = request  # of which kind is found out here
    if isinstance(asked, admin.RegistrationsWanted):
        return cast(A, _registrations(_carry_out(rest, admin.GraphWanted())))
    operation = operation_of(request)
    if operation is None or not operation.path or type(request) in _ONLY_THERE:
        raise NotRunningError(f"{rest.url}: {_ONLY_THERE.get(type(request), _UNASKED)}")
    body = _answer(rest, operation, request)
    match asked:
        case admin.MonitorLoad() | admin.MonitorReload() | admin.MonitorRemove() | admin.MonitorRollback():
            body["warnings"] = [_line(line) for line in body["warnings"]]
        case admin.HostPorts(name):
            body = {"name": name, "ports": body, "revision": 0}
    try:
        return msgspec.convert(body, admin.answer_to(type(request)))
    except msgspec.ValidationError as error:
        raise NotRunningError(f"{rest.url}: this appliance's version answers otherwise: {error}") from None


def _answer(rest: RestClient, operation: Operation, request: AdminRequest[Any]) -> dict[str, Any]:
    """What REST answers; a change is one of whatever is in force."""
    fields = msgspec.structs.asdict(request)
    path = operation.path.format_map({name: quote(str(value), safe="") for name, value in fields.items()})
    shown = {PARAMETERS.get(name, name): fields[name] for name in operation.query if fields[name]}
    params = {name: "1" if value is True else value for name, value in shown.items()}
    body = {**operation.says, **{field.name: fields[field.name] for field in operation.body()}}
    match = "expected" in fields and operation.method != "GET"
    return rest.call(operation.method, path, params=params or None, body=body or None, match=match)


_KIT = (
    "a kit is made on the appliance's machine, without --api; over REST take --token, with which no private key"
    " travels"
)
_ONLY_THERE: dict[type, str] = {
    admin.HostAdd: _KIT,
    admin.HostRenew: _KIT,
    admin.HostEndpoint: _KIT,
    admin.TokenAdd: "tokens are made on the appliance's machine only, without --api: an api that fell to a stranger"
    " gains no access that lasts",
}
_UNASKED = "this cannot be asked over REST; run it with --state"


def _line(finding: dict[str, Any]) -> str:
    """A finding as the admin socket has it."""
    return "{file}:{line}:{column}: {severity}: {text}".format_map(finding)


def _registrations(graph: Graph) -> Registrations:
    """What is live, as far as the graph shows it."""
    return Registrations(
        [
            Registration(node.host, node.name, call, resource)
            for node in graph.nodes
            for call, resources in (
                ("registerPublisher", node.publishes),
                ("registerSubscriber", node.subscribes),
                ("registerService", node.offers),
            )
            for resource in resources
        ]
    )
