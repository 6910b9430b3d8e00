"""`rosrv status`: the running appliance on one screen."""

import time
from collections.abc import Iterator
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from appliance.api.moments import in_full
from appliance.channel.admin import StatusWanted
from appliance.channel.answers.host_answers import PortsSeen
from appliance.channel.answers.status import FirewallState, IpsecState, PolicyState, ProcessInfo, Status
from appliance.channel.status_summary import no_relay, probe_failed
from appliance.cli.output import moment, say_json
from appliance.cli.status_view import age, doubted_clock, lacking_walls, processes_table, shortened
from appliance.cli.target import Appliance, speaks
from rosmop.tool.terminal import counted

_PORT_STATES = ("closed", "open", "unknown")
_MOST_NAMED = 8
_MOST_TROUBLES = 5
_RED, _YELLOW, _GREEN = "bold red", "yellow", "green"


@speaks
def status(
    appliance: Appliance, as_json: Annotated[bool, typer.Option("--json", help="One JSON object")] = False
) -> None:
    """Show the running appliance: processes, isolation, policy, graph, audit log.

    Exit status: 0 in service, 1 something needs a person, 2 not running.

    Example: rosrv status --state /var/lib/rosrv
    """
    body = appliance.ask_or_exit(StatusWanted())
    troubles = list(troubles_of(body))
    if as_json:
        say_json({**in_full(body), "troubles": troubles})
    else:
        show(body, troubles)
    raise typer.Exit(1 if troubles else 0)


def troubles_of(body: Status) -> list[str]:
    """What a person should look at, most pressing first."""
    found = []
    if body.audit.failed:
        found.append(f"the audit log cannot be written: {body.audit.failed}")
    if body.audit.degraded:
        found.append(f"the audit log is behind: {body.audit.degraded}")
    forwarding = body.audit.forwarding
    if forwarding is not None and forwarding.trouble:
        found.append(
            f"the audit log is not forwarded to {forwarding.to}, {counted(forwarding.behind, 'record')} wait:"
            f" {forwarding.trouble}"
        )
    if body.recorder is not None and not body.recorder.running:
        found.append("the flight recorder does not run: nothing is recorded at the moment")
    if probe_failed(body):
        found.append(f"the ROS Master is not hidden: {body.probe}")
    monitors = body.monitors
    if monitors.refused:
        found.append(f"the relay does not take the specifications: {monitors.refused[0]}")
    if monitors.held:
        why = "".join(f" ({name}: {reason})" for name, reason in monitors.why_held.items())
        found.append(f"topics are held{why}: rosrv monitor resume {' '.join(monitors.held)}")
    if monitors.failing:
        found.append(f"monitors fail: {', '.join(monitors.failing)}; their messages are dropped")
    found += [
        f"{off.what} since {moment(off.since)}: {off.again}" for off in body.switched_off if off.forgotten
    ]
    relay = no_relay(body.relay)
    if relay is not None:
        found.append(relay)
    if body.rosmaster != "reachable":
        found.append("the ROS Master is being rebuilt: calls wait")
    found += body.ipsec.troubles
    found += [_failing(process) for process in body.processes if process.failing]
    for what, verb, deadline in (
        ("the policy goes", "policy", body.policy.confirm_by),
        ("the specifications go", "monitor", monitors.confirm_by),
    ):
        if deadline is not None:
            left = max(0, round(deadline - time.time()))
            found.append(f"{what} back in {left} s unless confirmed: rosrv {verb} confirm")
    return found


def show(body: Status, troubles: list[str]) -> None:
    """Print a status for a person, what is wrong first."""
    console = Console(highlight=False)
    audit = body.audit
    for trouble in shortened(troubles, _MOST_TROUBLES):
        console.print(Text(f"! {trouble}", style=_RED))
    grid = Table.grid(padding=(0, 2))
    grid.add_row("appliance", f"{body.version} at {body.master}, for {age(body.since)}")
    isolation = Text(_isolation(body), style=_YELLOW if body.isolation == "none" else _GREEN)
    grid.add_row("isolation", isolation)
    lacking = lacking_walls(body.processes)
    if lacking is not None:
        grid.add_row("walls", Text(lacking, style=_YELLOW))
    doubted = doubted_clock(body.clock)
    if doubted is not None:
        grid.add_row("clock", Text(doubted, style=_YELLOW))
    for name, text in _others_rules(body.firewall):
        grid.add_row(name, text)
    grid.add_row("policy", _policy(body.policy))
    monitors = body.monitors
    loaded = counted(monitors.loaded, "monitor")
    shown = f"revision {monitors.revision}, {monitors.enabled} of {loaded} enabled"
    if monitors.trials:
        shown += f", {len(monitors.trials)} in shadow mode"
    if monitors.differs_from_folder:
        shown += f"; loaded by {monitors.who}, not what the folder has"
    grid.add_row("monitors", shown)
    for off in body.switched_off:
        end = "without an end" if off.until is None else f"until {moment(off.until)}"
        grid.add_row("switched off", Text(f"{off.what} since {moment(off.since)}, {end}", style=_YELLOW))
    shadows = f" ({body.shadows} lost, awaited)" if body.shadows else ""
    grid.add_row(
        "graph",
        f"{counted(body.nodes, 'node')}{shadows}, {counted(body.topics, 'topic')}, "
        f"{counted(body.services, 'service')}",
    )
    dropped = f", {body.dropped} dropped at slow subscribers" if body.dropped else ""
    relay = Text(f"{counted(body.connections, 'connection')}, {counted(body.messages, 'message')}{dropped}")
    if body.relaying == "monitored":
        relay.append("; only what is monitored: NO BOUNDARY, the rest passes it by", style=_YELLOW)
    grid.add_row("relay", relay)
    grid.add_row("tunnels", _tunnels(body.ipsec))
    grid.add_row("hosts' ports", _ports(body.ipsec.ports))
    forwarding = audit.forwarding
    forwarded = "" if forwarding is None else f", {forwarding.behind} to be forwarded to {forwarding.to}"
    grid.add_row("audit log", f"{counted(audit.lag_records, 'record')} waiting to be written{forwarded}")
    if body.recorder is not None:
        kept = body.recorder
        grid.add_row("recorder", f"{counted(kept.recordings, 'recording')}, {kept.bytes / 1e6:.1f} MB")
    console.print(grid)
    table = processes_table(body.processes, console.width)
    console.print(table)


def _failing(process: ProcessInfo) -> str:
    """Why a process is started again and again, and what it printed last."""
    lines = "".join(f"\n    {line}" for line in process.output)
    printed = f"; it printed last:{lines}" if lines else ""
    return (
        f"{process.role} is failing, after {counted(process.restarts, 'restart')}: {process.failing}{printed}"
    )


def _policy(policy: PolicyState) -> Text:
    differs = ""
    if policy.differs_from_file:
        theirs = policy.who != "disk"
        differs = f"; loaded by {policy.who}, not what the file has" if theirs else "; the file now differs"
        differs += "" if theirs else ": rosrv policy reload takes the file"
    warnings = f", {counted(policy.warnings, 'warning')}" if policy.warnings else ""
    line = Text(f"revision {policy.revision} of {policy.file}{warnings}{differs}")
    if policy.audit_only:
        line.append(f"; AUDIT-ONLY: refuses nothing by {', '.join(policy.audit_only)}", style=_YELLOW)
    return line


def _tunnels(ipsec: IpsecState) -> str:
    if ipsec.esp is None:
        return f"{counted(ipsec.enrolled, 'host')} enrolled"
    text = f"{ipsec.up} of {counted(ipsec.enrolled, 'enrolled host')} up, ESP in {ipsec.esp}"
    if ipsec.key_exchange:
        text += f", key exchange {', '.join(ipsec.key_exchange)}"
    return text


def _ports(known: dict[str, PortsSeen]) -> str:
    """Whether machines on which nodes run are known to be closed to all but the appliance."""
    by_state = {
        state: [name for name, ports in known.items() if ports.state == state] for state in _PORT_STATES
    }
    if not known:
        return "no other machine has nodes"
    words = [f"{state}: {', '.join(names[:_MOST_NAMED])}" for state, names in by_state.items() if names]
    return "; ".join(words) + (" (rosrv protect --check)" if by_state["unknown"] else "")


def _others_rules(firewall: FirewallState) -> Iterator[tuple[str, str]]:
    """What chains of other programs do on the host of isolation netns; their names are in the JSON object."""
    translating, dropping = firewall.translations or [], firewall.obstacles or []
    words = []
    if translating:
        words.append(
            f"{counted(len(translating), 'chain')} to translate addresses, not towards the appliance"
        )
    if dropping:
        words.append(f"{counted(len(dropping), 'chain')} to drop what is forwarded")
    if words:
        yield "others' rules", f"{'; '.join(words)}: --json"


def _isolation(body: Status) -> str:
    if body.isolation == "none":
        return "none: NO FIREWALL, every user of this machine reaches the ROS Master"
    back_end = body.firewall.backend or "no back end reported"
    told = all(row.walls for row in body.processes if row.role != "supervisor")
    walled = ", processes walled in" if told and lacking_walls(body.processes) is None else ""
    return f"{body.isolation}, firewall {back_end}, probe {body.probe or 'not run yet'}{walled}"
