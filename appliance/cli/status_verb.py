"""`rosrv status`: the running appliance on one screen."""

import datetime
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pkgutil import resolve_name
from typing import Annotated

import typer
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from appliance.api.front.moments import in_full
from appliance.base.actors import DISK
from appliance.base.counted import counted
from appliance.base.timestamps import age, in_local_zone
from appliance.channel.admin import A, AdminAnswer, StatusWanted
from appliance.channel.alarms import SWITCHED_OFF, Alarm, activity, open_alarms
from appliance.channel.answers.host_answers import PortsSeen
from appliance.channel.answers.status import (
    ClockState,
    FirewallState,
    IpsecState,
    PolicyState,
    ProcessInfo,
    Status,
)
from appliance.channel.status_summary import process_names
from appliance.cli.connection.admin_client import NotRunningError
from appliance.cli.connection.target import Appliance, speaks_with
from appliance.cli.output import loaded_by, moment, say_json, usage_error
from appliance.cli.status_watch import StatusView, Watch, seconds_between, watch_status
from appliance.features.views import pair_view, states_of
from appliance.policy.host_names import HostInWords
from rosmop.tool.tables import table_of

_NOTICES = ("hosts-blocked", "not-carried")
_PORT_STATES = ("closed", "open", "unknown")
_MAX_NAMED = 8
_MAX_TROUBLES = 5
_COLUMN = 38  # width for one process, in characters
_RED, _YELLOW, _GREEN = "bold red", "yellow", "green"


@speaks_with("One JSON object; with --watch, one on each line")
def status(
    appliance: Appliance,
    *,
    watch: Watch = False,
    every: Annotated[
        str | None,
        typer.Option(
            help="With --watch: the time between two statuses, 1s to 1h (default: 2s)", show_default=False
        ),
    ] = None,
) -> None:
    """Show the running appliance: processes, isolation, policy, graph, audit log.

    On a standby, show both appliances, as `rosrv standby status` does.

    Exit status: 0 in service, 1 needs attention, 2 not running; with --watch, that of the last status.

    Example: rosrv status --watch --every 5s
    """
    each = seconds_between(every, "rosrv status", watch=watch)
    try:
        if watch:
            raise typer.Exit(watch_status(partial(_look, appliance), each, as_json=appliance.as_json))
        view = appliance.body_or_exit(_answer(appliance))
    except NotRunningError as error:
        raise usage_error(str(error)) from None
    if appliance.as_json:
        say_json(view.fields)
    else:
        Console(highlight=False).print(view.screen)
    raise typer.Exit(view.exit_status)


def _look(appliance: Appliance) -> StatusView:
    return appliance.body_now(_answer(appliance))


def _answer(appliance: Appliance) -> AdminAnswer[StatusView]:
    answer = appliance.ask(StatusWanted())
    if answer.trouble == "standby":
        pair = pair_view()
        return _shown(appliance.ask(resolve_name(pair.request)()), resolve_name(pair.status))
    return _shown(answer, partial(_view, appliance=appliance))


def _shown(answer: AdminAnswer[A], view: Callable[[A], StatusView]) -> AdminAnswer[StatusView]:
    if answer.ok:
        return AdminAnswer(True, view(answer.unwrap()))
    return AdminAnswer(False, error=answer.error, findings=answer.findings, trouble=answer.trouble)


def _view(body: Status, appliance: Appliance) -> StatusView:
    alarms = troubles_of(body)
    troubles = [alarm.text for alarm in alarms]
    attention = [alarm.text for alarm in (*activity(body), *open_alarms(body)) if _is_attention(alarm, body)]
    fields = {**in_full(body), "troubles": troubles, "attention": attention}
    host_in_words = str if appliance.as_json or not body.ipsec.ports else appliance.host_in_words
    screen = StatusScreen(body, alarms, attention, host_in_words)
    return StatusView(1 if troubles else 0, screen, fields)


def _is_attention(alarm: Alarm, body: Status) -> bool:
    """Return whether an alarm that has no effect on the exit status is printed: recent denials and drops, monitors
    that were switched off, silenced alarms, and notices that no other line has.
    """
    return (
        alarm in activity(body)
        or alarm.kind.startswith(SWITCHED_OFF)
        or (alarm.severity == "notice" and (alarm.handled != "" or alarm.kind.startswith(_NOTICES)))
    )


def troubles_of(body: Status) -> list[Alarm]:
    """Return the conditions that need a person, now or soon; the exit status is 1 while there is one."""
    return [
        alarm
        for alarm in open_alarms(body)
        if alarm.severity != "notice"
        and alarm.kind != "policy-audit-only"
        and not alarm.kind.startswith(SWITCHED_OFF)
    ]


@dataclass(frozen=True, slots=True)
class StatusScreen:
    """Prints a status: problems come first, in red those that need a person now, then recent denials and drops."""

    body: Status
    troubles: list[Alarm]
    attention: list[str]
    host_in_words: HostInWords

    def __rich_console__(self, _console: Console, options: ConsoleOptions) -> RenderResult:
        grave = sum(alarm.severity == "alarm" for alarm in self.troubles)  # they come first
        for place, trouble in enumerate(shorten([alarm.text for alarm in self.troubles], _MAX_TROUBLES)):
            yield Text(f"! {in_local_zone(trouble)}", style=_RED if place < grave else _YELLOW)
        for line in map(in_local_zone, shorten(self.attention, _MAX_TROUBLES)):
            yield Text(f"attention: {line}", style=_YELLOW)
        yield _grid(self.body, self.host_in_words)
        yield processes_table(self.body.processes, options.max_width, self.body.now)


def _grid(body: Status, host_in_words: HostInWords) -> Table:
    audit = body.audit
    grid = Table.grid(padding=(0, 2))
    if body.name:
        grid.add_row("robot", body.name)
    grid.add_row("appliance", f"{body.version} at {body.master}, for {age(body.since, body.now)}")
    isolation = Text(_isolation(body), style=_YELLOW if body.isolation == "none" else _GREEN)
    grid.add_row("isolation", isolation)
    lacking = missing_sandbox(body.processes)
    if lacking is not None:
        grid.add_row("sandbox", Text(lacking, style=_YELLOW))
    doubted = doubted_clock(body.clock)
    if doubted is not None:
        grid.add_row("clock", Text(doubted, style=_YELLOW))
    for name, text in _others_rules(body.firewall):
        grid.add_row(name, Text(text))
    grid.add_row("policy", _policy(body.policy))
    monitors = body.monitors
    loaded = counted(monitors.loaded, "monitor")
    shown = f"revision {monitors.revision}, {monitors.enabled} of {loaded} enabled"
    if monitors.shadow:
        shown += f", {len(monitors.shadow)} in shadow mode"
    if monitors.differs_from_folder:
        shown += f"; {loaded_by(monitors.who, None)}, differs from the folder"
    grid.add_row("monitors", shown)
    for off in body.switched_off:
        end = "indefinitely" if off.until is None else f"until {moment(off.until)}"
        grid.add_row("switched off", Text(f"{off.what} since {moment(off.since)}, {end}", style=_YELLOW))
    if body.new_state is not None:
        lacks = f"without the {', '.join(body.new_state.lacks)} of an earlier one"
        grid.add_row(
            "state directory", Text(f"new since {moment(body.new_state.since)}, {lacks}", style=_YELLOW)
        )
    shadows = f" ({body.shadows} lost, awaited)" if body.shadows else ""
    grid.add_row(
        "graph",
        f"{counted(body.nodes, 'node')}{shadows}, {counted(body.topics, 'topic')}, "
        f"{counted(body.services, 'service')}",
    )
    dropped = f", {body.dropped} dropped at slow subscribers" if body.dropped else ""
    relay = Text(f"{counted(body.connections, 'connection')}, {counted(body.messages, 'message')}{dropped}")
    if body.relaying == "monitored":
        relay.append("; only monitored topics: NO BOUNDARY, the rest bypasses the relay", style=_YELLOW)
    grid.add_row("relay", relay)
    grid.add_row("tunnels", _tunnels(body.ipsec))
    grid.add_row("hosts' ports", _ports(body.ipsec.ports, host_in_words))
    lines = [view.line(state) for view, state in states_of(body) if view.line is not None]
    forwarded = "".join(f", {text}" for name, text in lines if not name)
    grid.add_row("audit log", f"{counted(audit.lag_records, 'record')} waiting to be written{forwarded}")
    for name, line in lines:
        if name:
            grid.add_row(name, line if isinstance(line, str) else Text.assemble(*line))
    return grid


def _policy(policy: PolicyState) -> Text:
    differs = ""
    if policy.differs_from_file:
        differs = "; differs from the file"
        if policy.file_refused:
            differs = "; the file is REFUSED: rosrv policy check"
        elif policy.who == DISK:
            differs = "; the file has changed, load it: rosrv policy reload"
    warnings = f", {counted(policy.warnings, 'warning')}" if policy.warnings else ""
    how = loaded_by(policy.who, policy.loaded)
    line = Text(f"revision {policy.revision} of {policy.file}, {how}{warnings}{differs}")
    if policy.audit_only:
        line.append(f"; AUDIT-ONLY: denies nothing by {', '.join(policy.audit_only)}", style=_YELLOW)
    return line


def _tunnels(ipsec: IpsecState) -> str:
    if ipsec.esp is None:
        return f"{counted(ipsec.enrolled, 'host')} enrolled"
    text = f"{ipsec.up} of {counted(ipsec.enrolled, 'enrolled host')} up, ESP in {ipsec.esp}"
    if ipsec.key_exchange:
        text += f", key exchange {', '.join(ipsec.key_exchange)}"
    return text


def _ports(known: dict[str, PortsSeen], host_in_words: HostInWords) -> str:
    by_state = {
        state: [name for name, ports in known.items() if ports.state == state] for state in _PORT_STATES
    }
    if not known:
        return "no other machine runs nodes"
    words = [
        f"{state}: {', '.join(map(host_in_words, names[:_MAX_NAMED]))}"
        for state, names in by_state.items()
        if names
    ]
    return "; ".join(words) + (
        " (on another machine: rosrv protect --check ADDRESS)" if by_state["unknown"] else ""
    )


def _others_rules(firewall: FirewallState) -> Iterator[tuple[str, str]]:
    if chains := firewall.translations:
        text = f"{counted(len(chains), 'chain')} translating addresses, none towards the appliance: --json"
        yield "others' rules", text
    for obstacle in shorten(firewall.obstacles or [], _MAX_TROUBLES):
        yield "obstacle", obstacle


def _isolation(body: Status) -> str:
    if body.isolation == "none":
        return "none: NO FIREWALL, every user of this machine can reach the ROS master"
    back_end = body.firewall.backend or "no back end reported"
    reported = all(row.sandbox for row in body.processes if row.role != "supervisor")
    sandboxed = ", processes sandboxed" if reported and missing_sandbox(body.processes) is None else ""
    return f"{body.isolation}, firewall {back_end}, probe {body.probe or 'not run yet'}{sandboxed}"


def processes_table(rows: Sequence[ProcessInfo], width: int, now: float | None = None) -> Table:
    across = max(1, min(3, width // _COLUMN))
    high = -(-len(rows) // across)
    table = table_of(*["process", "pid", "for", "restarts"] * across)
    shown = [_cells(row, name, now) for row, name in zip(rows, process_names(rows), strict=True)]
    for line in range(high):
        cells: list[Text] = []
        for place in range(line, len(shown), high):
            cells += shown[place]
        table.add_row(*cells)
    return table


def _cells(row: ProcessInfo, name: str, now: float | None) -> list[Text]:
    since = datetime.datetime.fromisoformat(row.since).timestamp()
    restarts = Text(str(row.restarts), style=_YELLOW if row.restarts else "")
    return [Text(name), Text(str(row.pid)), Text(age(since, now)), restarts]


def missing_sandbox(rows: Sequence[ProcessInfo]) -> str | None:
    lacking = [f"{row.role}: {what}" for row in rows for what in row.lacks]
    if not lacking:
        return None
    return lacking[0] + (f" and {len(lacking) - 1} more (rosrv status --json)" if len(lacking) > 1 else "")


def doubted_clock(clock: ClockState) -> str | None:
    if clock.before_program_seconds:
        days = clock.before_program_seconds / 86_400
        return (
            f"wrong: {days:.0f} days before this program was built; set it before hosts get certificates"
            " (rights with a time grant nothing until then)"
        )
    if clock.behind_seconds:
        return f"set back: {clock.behind_seconds:.0f} s before the last record"
    if clock.synchronised is None:
        return "synchronisation unknown: the kernel does not report it"
    return None if clock.synchronised else "not synchronised: run chrony or systemd-timesyncd"


def shorten(lines: Sequence[str], most: int) -> list[str]:
    if len(lines) <= most:
        return list(lines)
    return [*lines[: most - 1], f"and {len(lines) - most + 1} more: rosrv status --json"]
