"""The command `rosrv report interventions`."""

import ipaddress
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from appliance import __version__
from appliance.audit.log.record_format import rfc3339
from appliance.audit.search.filter_options import Since, Until, times_given
from appliance.audit.search.query import Filter
from appliance.base import clock
from appliance.base.counted import counted
from appliance.base.timestamps import parse_timestamp
from appliance.channel.admin import PolicyWanted, StatusWanted, TokenList
from appliance.channel.answers.policy_answers import PolicyInForce
from appliance.channel.answers.token_answers import Tokens
from appliance.cli.audit.audit_errors import Errors
from appliance.cli.audit.verified import last_verification
from appliance.cli.connection.admin_client import NotRunningError
from appliance.cli.connection.audit_file import FileLog
from appliance.cli.connection.audit_source import audit_of
from appliance.cli.connection.target import Appliance, speaks_with
from appliance.cli.output import OR_STANDARD, say_json, usage_error, write_new
from appliance.features.logbook.log_source import Log, OpenedLogs, Other, logs_of
from appliance.formats.interventions import READ
from appliance.formats.machine_report import (
    MachineInterface,
    MachineReport,
    MachineRight,
    Period,
    Reading,
    ReportedLog,
    read_records,
)
from appliance.formats.report_words import page, report_lines
from appliance.policy.judgement import PolicyContext, ends_of
from appliance.policy.model import Category, address_of
from appliance.policy.policy import Policy
from appliance.policy.policy_findings import PolicyError
from rosmop.tool.terminal import say

# Say which interfaces the running appliance has, what protects each, and who may act on it. No I/O.

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
    if any(process["role"] == "api" for process in status["processes"]):
        issuer = _sign_on(records).get("issuer", "off")
        sign_on = issuer if records.settings is not None else "unknown: the log has no start"
        yield MachineInterface(
            name="REST and console", where="api of appliance.yaml", commands="orders of the token's or person's role",
            protection=f"TLS, unless api_tls is off; tokens: {by_role}; single sign-on: {sign_on}",
        )  # fmt: skip
    yield MachineInterface(
        name="admin socket", where="the appliance's machine", commands="all orders",
        protection="permissions of the file: root",
    )  # fmt: skip
    for door in (status.get("doors") or {}).get("doors", ()):
        place = records.places.get(door["name"], "see `rosrv door list`")
        entry = "a ticket" if ", port none, " in place else "a ticket; at its own port only the address"
        yield MachineInterface(
            name=f"door {door['name']}", where=place, commands="what the policy grants its name",
            protection=f"{entry}; the policy; monitors of its topics",
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
    yield MachineRight(what="every order", who="root", by="the appliance's machine")
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
    rules = {"" if rule.key is None else rule.key.text: rule for rule in policy.rules(Category.COMMAND)}
    if rule := rules.get("shutdown") or rules.get(""):
        yield MachineRight(what=f"{_STOP}: end a node", who=rule.shown, by=rule.place)


def _sign_on(records: Reading) -> Mapping[str, str]:
    """Return the settings of single sign-on; empty if it is off, or if an earlier version wrote the log."""
    return (records.settings or {}).get("sso", {})


_VERIFY, _VERIFY_BOTH = "rosrv audit verify", "rosrv audit verify --other DIR"
_VERB = "rosrv report"


@speaks_with("One JSON object: the whole report")
def report_interventions(
    appliance: Appliance,
    *,
    since: Since = None,
    until: Until = None,
    after: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Continue an earlier report, from its end: the file of its --json output"
        ),
    ] = None,
    other: Other = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help=f"File for one HTML page without scripts; must not exist; {OR_STANDARD}",
        ),
    ] = None,
) -> None:
    """Report who changed which safety setting of the robot, its values before and after, and the gaps of the log.

    The report has all changes of the policy, guards, monitors, driving rights, approvals, blocks, doors, tokens,
    hosts, alarms and software. It also says what was off or blocked and for how long, who drove, and which interfaces
    are present, such as REST and doors. It contains no secret and no value of a ROS parameter. It does not verify the
    log: `rosrv audit verify` does, and the report names its last result on this machine. With --other, it covers both
    appliances of a pair.

    Example: rosrv report interventions --since 2026-03-01 --output march.html
    """
    with Errors():
        if since is not None and after is not None:
            raise usage_error("give --since or --after, not both", verb=_VERB)
        begin, end = times_given(since, until)
        if after is not None:
            begin = _end_of(after)
        end = clock.wall_ns() if end is None else end
        report = _report(appliance, begin, end, other)
    if output is not None:
        write_new(output, page(report, appliance.host_in_words), verb=_VERB)
        sys.stderr.write(f"rosrv: written to {output}\n")
    if appliance.as_json:
        say_json(report)
    elif output is None:
        for line in report_lines(report, appliance.host_in_words):
            say(line)


def _report(appliance: Appliance, since: int | None, end: int, other: Path | None) -> MachineReport:
    logs = logs_of(audit_of(appliance.way), other, _VERB)
    sources = [_reported(name, log) for name, log in logs.items()]
    begins = min((source.begins_utc for source in sources if source.begins_utc), default="")
    if since is None:
        since = parse_timestamp(begins, end) if begins else end
    period = Period(since, end)
    with OpenedLogs(logs) as opened:
        read = read_records(opened.of_events(READ), period, opened.with_origin)
    facts = _Live.of(appliance, read)
    return MachineReport(
        robot=facts.robot, logs=sources, since_utc=rfc3339(period.since), until_utc=rfc3339(end),
        made_utc=rfc3339(clock.wall_ns()), version=__version__, verify=_VERIFY if other is None else _VERIFY_BOTH,
        interfaces=facts.interfaces, rights=facts.rights, live_reason=facts.reason,
        interventions=read.interventions, switched_off=read.switched_off, blocks=read.blocks, software=read.software,
        drivers=read.drivers, gaps=read.gaps,
    )  # fmt: skip


class _Live(msgspec.Struct):
    robot: str = ""
    interfaces: list[MachineInterface] = []
    rights: list[MachineRight] = []
    reason: str = ""

    @classmethod
    def of(cls, appliance: Appliance, records: Reading) -> "_Live":
        try:
            status, policy = appliance.ask(StatusWanted()), appliance.ask(PolicyWanted())
            tokens = appliance.ask(TokenList())
        except NotRunningError as error:
            return cls(reason=f"not known: {error}")
        for answer in (status, policy, tokens):
            if not answer.ok:
                return cls(reason=f"not known: {answer.error}")
        state, text, made = msgspec.to_builtins(status.unwrap()), policy.unwrap(), tokens.unwrap()
        known = PolicyContext(
            {name: address_of(address) for name, address in text.hosts.items()},
            [ipaddress.ip_network(place) for place in text.robot],
            own=[ipaddress.ip_address(address) for address in text.own],
            now=text.now,
            ends=ends_of(text.ended, text.lasting),
        )
        try:
            compiled = known.compile(text.text, text.file)
        except PolicyError as error:
            return cls(
                reason=f"not known: this program's version does not read the policy in force: {error.findings[0]}"
            )
        return cls(
            str(state["name"]),
            list(interfaces(state, text, made, records)),
            list(rights(compiled, text, made, records)),
        )


def _reported(name: str, log: Log) -> ReportedLog:
    first = log.search(Filter(), None, 1, newest_first=False).entries
    at_hand = log if isinstance(log, FileLog) else None
    return ReportedLog(
        name=name, id=at_hand.present() if at_hand is not None else "",
        begins_utc=rfc3339(first[0].record.time) if first else "",
        last=log.last(), verification=last_verification(at_hand.path) if at_hand is not None else None,
    )  # fmt: skip


def _end_of(file: Path) -> int:
    try:
        text = str(msgspec.json.decode(file.read_bytes())["until_utc"])
        return parse_timestamp(text, clock.wall_ns())
    except OSError as error:
        raise usage_error(f"--after: {file} cannot be read: {error.strerror}", verb=_VERB) from error
    except (ValueError, KeyError, TypeError) as error:
        raise usage_error(
            f"--after: {file} is not a report: give the output of `rosrv report interventions --json`",
            verb=_VERB,
        ) from error
