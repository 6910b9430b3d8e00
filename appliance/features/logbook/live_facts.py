"""Say which interfaces the running appliance has, what protects each, and who may act on it. No I/O."""

from collections.abc import Iterator, Mapping
from typing import Any

from appliance.base.counted import counted
from appliance.channel.answers.policy_answers import PolicyInForce
from appliance.channel.answers.token_answers import Tokens
from appliance.formats.machine_report import MachineInterface, MachineRight, Reading
from appliance.policy.model import Category
from appliance.policy.policy import Policy

_ACTS = (Category.PUBLISH, Category.CALL, Category.WRITE)
_WORDS = {Category.PUBLISH: "publish", Category.CALL: "call", Category.WRITE: "write"}
_STOP = "stop the robot remotely"
_ALSO_STOPS = {
    Category.PUBLISH: f" ({_STOP}, if it takes commands)", Category.CALL: f" ({_STOP}, if it is a stop)",
}  # fmt: skip


def interfaces(
    status: Mapping[str, Any], policy: PolicyInForce, tokens: Tokens, records: Reading
) -> Iterator[MachineInterface]:
    """Yield the ways in. `status` is the answer of `rosrv status --json`; the records have the places of doors."""
    rules = f"policy revision {policy.revision} decides each call by the sender's address"
    lenient = status["policy"]["audit_only"]
    if lenient:
        rules += f"; audit-only, so only recorded: {', '.join(lenient)}"
    blocked = status["blocks"]["hosts"]
    yield MachineInterface(
        name="ROS Master API", where=str(status["master"]), commands="registrations, parameters",
        protection=f"{rules}; {counted(blocked, 'host')} blocked",
    )  # fmt: skip
    monitors = status["monitors"]
    yield MachineInterface(
        name="topics and services (relay)", where="ports of [Ports] in the policy",
        commands="messages and service calls",
        protection=f"{rules}; {monitors['enabled']} of {counted(monitors['loaded'], 'monitor')} enabled;"
        f" relaying: {status['relaying']}, isolation: {status['isolation']}",
    )  # fmt: skip
    usable = [token for token in tokens.tokens if token.valid and token.revoked is None]
    by_role = ", ".join(
        f"{sum(token.role == role for token in usable)} {role}"
        for role in ("viewer", "investigator", "operator", "admin")
    )
    yield MachineInterface(
        name="REST and console", where="api of appliance.yaml", commands="orders of the token's or person's role",
        protection=f"TLS; tokens: {by_role}; single sign-on: {_sign_on(records).get('issuer', 'off')}",
    )  # fmt: skip
    yield MachineInterface(
        name="admin socket", where="the appliance's machine", commands="all orders",
        protection="permissions of the file: root and the appliance's group",
    )  # fmt: skip
    for door in (status.get("doors") or {}).get("doors", ()):
        yield MachineInterface(
            name=f"door {door['name']}", where=records.places.get(door["name"], "see `rosrv door list`"),
            commands="what the policy grants its name", protection="a ticket; the policy; monitors of its topics",
        )  # fmt: skip
    tunnels = status["ipsec"]
    if tunnels["esp"] is not None:
        yield MachineInterface(
            name="IPsec tunnels", where="UDP 500 and 4500, ESP", commands="none of their own: they carry the others",
            protection=f"certificates of {counted(tunnels['enrolled'], 'host')}; {' '.join(tunnels['key_exchange'])}",
        )  # fmt: skip
    if status.get("standby") is not None:
        yield MachineInterface(
            name="the other appliance and the witness", where="TCP and UDP 7411 and 7412",
            commands="the state, and who serves", protection="mutual TLS; signed datagrams",
        )  # fmt: skip


def rights(
    policy: Policy, in_force: PolicyInForce, tokens: Tokens, records: Reading
) -> Iterator[MachineRight]:
    """Yield each right to act on the machine, or to change its safety settings."""
    usable = [token for token in tokens.tokens if token.valid and token.revoked is None]

    def holders(*roles: str) -> str:
        return ", ".join(sorted({token.name for token in usable if token.role in roles})) or "no token"

    keys = in_force.site_keys
    signed = f", signed by one of {counted(len(keys), 'site key')}" if keys else ""
    yield MachineRight(what="every order", who="root and the appliance's group", by="the appliance's machine")
    yield MachineRight(
        what=f"change policies, monitors and guards{signed}", who=holders("admin"), by="token, role admin"
    )
    yield MachineRight(
        what="load policies and guards that exist already, set guards' values, switch monitors, approve",
        who=holders("operator"),
        by="token, role operator",
    )  # fmt: skip
    sign_on = _sign_on(records)
    if "roles" in sign_on:
        claim = f"the claim {sign_on.get('roles_claim', '')} of {sign_on.get('issuer', '')}"
        yield MachineRight(
            what="the rights of the roles admin and operator, over single sign-on",
            who=f"people with {sign_on['roles']}",
            by=claim,
        )
    yield MachineRight(
        what=f"{_STOP}: block a host, whose motions guards then stop", who=holders("admin", "operator"),
        by="token, role admin or operator",
    )  # fmt: skip
    yield from _ends(policy)
    for category in _ACTS:
        for rule in policy.rules(category):
            name = rule.key.text if rule.key is not None else "all others"
            yield MachineRight(
                what=f"{_WORDS[category]} {name}{_ALSO_STOPS.get(category, '')}", who=rule.shown,
                by=rule.place,
            )  # fmt: skip


def _ends(policy: Policy) -> Iterator[MachineRight]:
    for rule in policy.rules(Category.COMMAND):
        if rule.key is None or rule.key.text == "shutdown":
            yield MachineRight(what=f"{_STOP}: end a node", who=rule.shown, by=rule.place)


def _sign_on(records: Reading) -> Mapping[str, str]:
    """Return the settings of single sign-on; empty if it is off, or if an earlier version wrote the log."""
    return records.settings.get("sso", {})
