"""Send admin requests as REST calls, and convert the answers to the admin socket's answers."""

from pathlib import Path
from typing import cast

import msgspec

from appliance.channel import admin
from appliance.channel.admin import A, AdminAnswer, AdminRequest, Trouble, operation_of
from appliance.channel.answers.graph_answers import Graph, Registration, Registrations
from appliance.channel.rest_meaning import call_of
from appliance.cli.connection.admin_client import NotRunningError, RestProblemError, encode_request
from appliance.cli.connection.rest_session import RestClient


class RestWay:
    """Sends the requests of `AdminSocket` over REST, with the same answers."""

    def __init__(self, url: str, token: str | None, ca_file: Path | None) -> None:
        """Raises `ValueError` if a token must not be sent to this URL."""
        self.client = RestClient(url, token, ca_file)

    def ask(self, request: AdminRequest[A]) -> AdminAnswer[A]:
        encode_request(request)  # rejects text that the socket would also reject
        try:
            return AdminAnswer(True, _carry_out(self.client, request))
        except RestProblemError as problem:
            trouble: Trouble = "unknown" if problem.status == 404 else ""
            if problem.kind == "standby":
                trouble = "standby"
            return AdminAnswer(False, error=problem.lines[0], findings=problem.lines[1:], trouble=trouble)


def _carry_out(rest: RestClient, request: AdminRequest[A]) -> A:
    """Return the answer. Raises `NotRunningError` for a request that REST does not offer."""
    asked: object = request  # its kind is checked below
    if isinstance(asked, admin.RegistrationsWanted):
        return cast(A, _registrations(_carry_out(rest, admin.GraphWanted())))
    operation = operation_of(request)
    if isinstance(asked, admin.TokenAdd | admin.TokenRotate):
        raise NotRunningError(f"{rest.url}: {_MACHINE_ONLY}")
    if operation is None or not operation.path or operation.machine_only:
        raise NotRunningError(f"{rest.url}: {(operation and operation.machine_only) or _UNASKED}")
    call = call_of(request, operation)
    body = rest.call(call.method, call.target, body=call.body, match=call.match)
    if operation.answer_field:
        body = {operation.answer_field: body}
    try:
        return msgspec.convert(body, admin.answer_to(type(request)))
    except msgspec.ValidationError as error:
        raise NotRunningError(
            f"{rest.url}: this appliance's version gives a different answer: {error}; use the rosrv of its version"
        ) from None


_MACHINE_ONLY = (
    "tokens are made on the appliance's machine only, without --api: a compromised api gains no lasting"
    " access"
)
_UNASKED = "this cannot be asked over REST; run it with --state"


def _registrations(graph: Graph) -> Registrations:
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
