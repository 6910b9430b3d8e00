"""What is asked about hosts, as calls of REST, and the answers as the admin socket gives them."""

from typing import Any
from urllib.parse import quote

from appliance.channel import admin
from appliance.cli.admin_socket import NotRunningError
from appliance.cli.rest.calls import Calls

_HOSTS = "/v1/hosts"


def carry_out_on_hosts(rest: Calls, request: admin.AdminRequest) -> dict[str, Any]:
    """Ask over REST; the body that the admin socket's answer would have."""
    match request:
        case admin.HostList():
            return rest.call("GET", _HOSTS)
        case admin.HostsReload():
            return rest.call("POST", f"{_HOSTS}/reload", match=True)
        case admin.HostRevoke(name):
            return rest.call("DELETE", _of(name), match=True)
        case admin.HostPorts(name, state, opened, checked):
            body = {"state": state, "open": opened, "checked": checked}
            return {"name": name, "ports": rest.call("PUT", f"{_of(name)}/ports", body=body, match=True)}
        case admin.HostToken():
            return _token(rest, request)
        case admin.HostAdd() | admin.HostRenew():
            raise NotRunningError(
                f"{rest.url}: a kit is made on the appliance's machine, without --api; over REST take --token, with"
                " which no private key travels"
            )
        case _:
            raise NotRunningError(f"{rest.url}: this cannot be asked over REST; run it with --state")


def _token(rest: Calls, request: admin.HostToken) -> dict[str, Any]:
    kit = request.kit
    asked = {
        "endpoint": kit["endpoint"] or None,
        "ports": kit["ports"],
        "open": [one for one in kit["open"].split(",") if one],
        "days": request.days,
        "address": request.address,
        "token_seconds": request.seconds,
    }
    if request.new:
        made = rest.call("POST", _HOSTS, body={"name": request.name, "how": "token", **asked}, match=True)
    else:
        made = rest.call("POST", f"{_of(request.name)}/token", body=asked, match=True)
    return {**made, "token_expires": made["expires"]}


def _of(name: str) -> str:
    return f"{_HOSTS}/{quote(name, safe='')}"
