"""What operators' tools ask, as calls of REST, and the answers as the admin socket gives them."""

from typing import Any
from urllib.parse import quote

from appliance.channel import admin
from appliance.cli.admin_socket import NotRunningError
from appliance.cli.rest.calls import Calls
from appliance.cli.rest.host_orders import carry_out_on_hosts

_OfMonitors = (
    admin.MonitorsWanted | admin.MonitorLoad | admin.MonitorReload | admin.MonitorRemove | admin.MonitorSwitch
    | admin.MonitorResume
)  # fmt: skip


def carry_out(rest: Calls, request: admin.AdminRequest) -> dict[str, Any]:
    """Ask over REST; the body that the admin socket's answer would have."""
    match request:
        case admin.StatusWanted() | admin.GraphWanted():
            return rest.call("GET", "/v1/status" if isinstance(request, admin.StatusWanted) else "/v1/graph")
        case admin.RegistrationsWanted():
            return {"registrations": _registrations(rest.call("GET", "/v1/graph"))}
        case admin.PolicyReload() | admin.PolicyRollback() | admin.PolicyConfirm() | admin.PolicyRevisions():
            return _policy(rest, request)
        case (
            admin.MonitorsWanted()
            | admin.MonitorLoad()
            | admin.MonitorReload()
            | admin.MonitorRemove()
            | admin.MonitorSwitch()
            | admin.MonitorResume()
        ):
            return _monitors(rest, request)
        case admin.TokenAdd() | admin.TokenList() | admin.TokenRevoke():
            return _tokens(rest, request)
        case _:
            return carry_out_on_hosts(rest, request)


def _tokens(rest: Calls, request: admin.TokenAdd | admin.TokenList | admin.TokenRevoke) -> dict[str, Any]:
    match request:
        case admin.TokenList():
            return rest.call("GET", "/v1/tokens")
        case admin.TokenRevoke(name):
            return rest.call("DELETE", f"/v1/tokens/{quote(name, safe='')}")
        case admin.TokenAdd():
            raise NotRunningError(
                f"{rest.url}: tokens are made on the appliance's machine only, without --api: an api that fell to "
                "a stranger gains no access that lasts"
            )


def _policy(
    rest: Calls,
    request: admin.PolicyReload | admin.PolicyRollback | admin.PolicyConfirm | admin.PolicyRevisions,
) -> dict[str, Any]:
    match request:
        case admin.PolicyRevisions():
            return rest.call("GET", "/v1/policy/revisions")
        case admin.PolicyReload(confirm_within):
            params = {} if confirm_within is None else {"confirm_within": confirm_within}
            return rest.call("POST", "/v1/policy/reload", params=params, match=True)
        case admin.PolicyRollback(revision):
            return rest.call("POST", "/v1/policy/rollback", body={"revision": revision}, match=True)
        case admin.PolicyConfirm():
            return rest.call("POST", "/v1/policy/confirm", match=True)


def _monitors(rest: Calls, request: _OfMonitors) -> dict[str, Any]:
    path = "/v1/monitors"
    match request:
        case admin.MonitorsWanted(texts):
            return rest.call("GET", path, params={"texts": "1"} if texts else None)
        case admin.MonitorLoad(files, definitions, note):
            body = {"files": files, "definitions": definitions, "note": note}
            return _replaced(rest.call("POST", path, body=body, match=True))
        case admin.MonitorReload(prune=prune):
            params = {"prune": "1"} if prune else None
            return _replaced(rest.call("POST", f"{path}/reload", params=params, match=True))
        case admin.MonitorRemove(names):
            return _replaced(rest.call("DELETE", path, params={"name": names}, match=True))
        case admin.MonitorSwitch(names, enabled):
            answer = rest.call("PATCH", path, body={"names": names, "enabled": enabled}, match=True)
            return {**answer, "enabled": enabled}
        case admin.MonitorResume(names):
            return rest.call("PATCH", path, body={"names": names, "held": False}, match=True)


def _replaced(body: dict[str, Any]) -> dict[str, Any]:
    shown = {name: value for name, value in body.items() if name not in ("loaded", "monitors", "warnings")}
    warnings = [
        f"{one['file']}:{one['line']}:{one['column']}: {one['severity']}: {one['text']}"
        for one in body["warnings"]
    ]
    return {**shown, "warnings": warnings}


def _registrations(graph: dict[str, Any]) -> list[dict[str, str]]:
    calls = {
        "publishes": "registerPublisher", "subscribes": "registerSubscriber", "offers": "registerService",
    }  # fmt: skip
    return [
        {"host": node["host"], "caller_id": node["name"], "call": call, "resource": resource}
        for node in graph["nodes"]
        for field, call in calls.items()
        for resource in node[field]
    ]
