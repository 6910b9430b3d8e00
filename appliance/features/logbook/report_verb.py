"""The command `rosrv report interventions`."""

import ipaddress
import sys
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from appliance import __version__
from appliance.audit.log.record_format import rfc3339
from appliance.audit.search.filter_options import Since, Until, times_given
from appliance.audit.search.query import Filter
from appliance.base import clock
from appliance.base.timestamps import parse_timestamp
from appliance.channel.admin import PolicyWanted, StatusWanted, TokenList
from appliance.cli.audit.audit_errors import Errors
from appliance.cli.audit.verified import last_verification
from appliance.cli.connection.admin_client import NotRunningError
from appliance.cli.connection.audit_file import FileLog
from appliance.cli.connection.audit_source import audit_of
from appliance.cli.connection.target import Appliance, speaks_with
from appliance.cli.output import say_json, usage_error, write_new
from appliance.features.logbook import live_facts
from appliance.features.logbook.log_source import Log, OpenedLogs, Other, logs_of
from appliance.formats.interventions import READ
from appliance.formats.machine_report import (
    MachineInterface,
    MachineReport,
    MachineRight,
    Period,
    Reading,
    ReportedLog,
    VerificationResult,
    read_records,
)
from appliance.formats.report_words import page, report_lines
from appliance.policy.judgement import PolicyContext
from appliance.policy.model import address_of
from appliance.policy.policy_findings import PolicyError
from rosmop.tool.terminal import say

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
            "--output", "-o", metavar="FILE", help="File for one HTML page without scripts; must not exist"
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
        found = _report(appliance, begin, end, other)
    if output is not None:
        write_new(output, page(found, appliance.host_in_words), verb=_VERB)
        sys.stderr.write(f"rosrv: written to {output}\n")
    if appliance.as_json:
        say_json(found)
    elif output is None:
        for line in report_lines(found, appliance.host_in_words):
            say(line)


def _report(appliance: Appliance, since: int | None, end: int, other: Path | None) -> MachineReport:
    logs = logs_of(audit_of(appliance.way), other, _VERB)
    sources = [_reported(name, log) for name, log in logs.items()]
    begins = min((one.begins_utc for one in sources if one.begins_utc), default="")
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
        state, text, made = msgspec.to_builtins(status.given()), policy.given(), tokens.given()
        known = PolicyContext(
            {name: address_of(address) for name, address in text.hosts.items()},
            [ipaddress.ip_network(place) for place in text.robot],
            own=[ipaddress.ip_address(address) for address in text.own],
        )
        try:
            compiled = known.compiled(text.text, text.file)
        except PolicyError as error:
            return cls(
                reason=f"not known: this program's version does not read the policy in force: {error.findings[0]}"
            )
        return cls(
            str(state["name"]),
            list(live_facts.interfaces(state, text, made, records)),
            list(live_facts.rights(compiled, text, made, records)),
        )


def _reported(name: str, log: Log) -> ReportedLog:
    first = log.search(Filter(), None, 1, newest_first=False).entries
    at_hand = log if isinstance(log, FileLog) else None
    return ReportedLog(
        name=name, id=at_hand.present() if at_hand is not None else "",
        begins_utc=rfc3339(first[0].record.time) if first else "",
        last=log.last(), verification=_verification(at_hand) if at_hand is not None else None,
    )  # fmt: skip


def _verification(log: FileLog) -> VerificationResult | None:
    stored = last_verification(log.path)
    return None if stored is None else msgspec.convert(msgspec.to_builtins(stored), VerificationResult)


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
