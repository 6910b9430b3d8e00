"""What operators' tools ask, as calls of REST; the answers are those of the admin socket."""

from typing import Any, NamedTuple, cast
from urllib.parse import quote

import msgspec

from appliance.channel import admin
from appliance.channel.admin import A, AdminRequest
from appliance.channel.answers.graph import Graph, Registration, Registrations
from appliance.cli.admin_socket import NotRunningError
from appliance.cli.rest.session import RestClient

_GRAPH, _HOSTS, _MONITORS, _POLICY, _TOKENS = (
    f"/v1/{word}" for word in ("graph", "hosts", "monitors", "policy", "tokens")
)


class _Call(NamedTuple):
    """A call of REST; `tagged`: a change of what is in force, whatever that is."""

    method: str
    path: str
    body: Any = None
    params: dict[str, Any] | None = None
    tagged: bool = True


def carry_out(rest: RestClient, request: AdminRequest[A]) -> A:
    """Ask over REST. Raises `NotRunningError` for what is not asked there."""
    asked: Any = request  # of which kind is found out here
    if isinstance(asked, admin.RegistrationsWanted):
        return cast(A, _registrations(carry_out(rest, admin.GraphWanted())))
    call = _call_of(asked, rest.url)
    match = call.tagged and call.method != "GET"
    body = rest.call(call.method, call.path, params=call.params, body=call.body, match=match)
    match asked:
        case admin.MonitorLoad() | admin.MonitorReload() | admin.MonitorRemove():
            body["warnings"] = [_line(one) for one in body["warnings"]]
        case admin.HostPorts(name):
            body = {"name": name, "ports": body, "revision": 0}
    try:
        return msgspec.convert(body, admin.answer_to(type(request)))
    except msgspec.ValidationError as error:
        raise NotRunningError(f"{rest.url}: this appliance's version answers otherwise: {error}") from None


def _call_of(request: AdminRequest[Any], url: str) -> _Call:  # noqa: PLR0911, PLR0912  one for each
    match request:
        case admin.StatusWanted():
            return _Call("GET", "/v1/status")
        case admin.InventoryWanted():
            return _Call("GET", "/v1/inventory")
        case admin.GraphWanted():
            return _Call("GET", _GRAPH)
        case admin.PolicyRevisions():
            return _Call("GET", f"{_POLICY}/revisions")
        case admin.PolicyReload(confirm_within):
            params = None if confirm_within is None else {"confirm_within": confirm_within}
            return _Call("POST", f"{_POLICY}/reload", params=params)
        case admin.PolicyRollback(revision):
            return _Call("POST", f"{_POLICY}/rollback", {"revision": revision})
        case admin.PolicyConfirm():
            return _Call("POST", f"{_POLICY}/confirm")
        case admin.MonitorsWanted(texts):
            return _Call("GET", _MONITORS, params={"texts": "1"} if texts else None)
        case admin.MonitorLoad(files, definitions, note):
            return _Call("POST", _MONITORS, {"files": files, "definitions": definitions, "note": note})
        case admin.MonitorReload(prune=prune):
            return _Call("POST", f"{_MONITORS}/reload", params={"prune": "1"} if prune else None)
        case admin.MonitorRemove(names):
            return _Call("DELETE", _MONITORS, params={"name": names})
        case admin.MonitorSwitch(names, enabled):
            return _Call("PATCH", _MONITORS, {"names": names, "enabled": enabled})
        case admin.MonitorResume(names):
            return _Call("PATCH", _MONITORS, {"names": names, "held": False})
        case admin.TokenList():
            return _Call("GET", _TOKENS)
        case admin.TokenRevoke(name):
            return _Call("DELETE", _of(_TOKENS, name), tagged=False)
        case admin.HostList():
            return _Call("GET", _HOSTS)
        case admin.HostsReload():
            return _Call("POST", f"{_HOSTS}/reload")
        case admin.HostRevoke(name):
            return _Call("DELETE", _of(_HOSTS, name))
        case admin.HostPorts(name, state, opened, checked):
            told = {"state": state, "open": opened, "checked": checked}
            return _Call("PUT", f"{_of(_HOSTS, name)}/ports", told)
        case admin.HostToken(name):
            new = {"name": name, "how": "token"} if request.new else {}
            return _Call("POST", _HOSTS if new else f"{_of(_HOSTS, name)}/token", new | _wishes(request))
        case _:
            raise NotRunningError(f"{url}: {_ONLY_THERE.get(type(request), _UNASKED)}")


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


def _wishes(request: admin.HostToken) -> dict[str, Any]:
    kit = request.kit
    return {
        "endpoint": kit["endpoint"] or None,
        "ports": kit["ports"],
        "open": [one for one in kit["open"].split(",") if one],
        "days": request.days,
        "address": request.address,
        "token_seconds": request.seconds,
    }


def _of(path: str, name: str) -> str:
    return f"{path}/{quote(name, safe='')}"


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
