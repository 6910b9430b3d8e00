"""`rosrv monitor list|enable|enforce|disable|remove|reload|resume`: monitors of the running appliance."""

from typing import Annotated

import typer
from rich.table import Column

from appliance.api.front.moments import in_full
from appliance.channel import admin
from appliance.channel.answers.monitor_answers import MonitorState, Switched
from appliance.channel.messages import GivenValue
from appliance.cli import completion
from appliance.cli.commit_confirm import ConfirmWithin, seconds_within
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.durations import bounded_span
from appliance.cli.monitor_changes import Hold, say_held, say_replaced, say_shadow_deadline, write_switches
from appliance.cli.output import loaded_by, moment, say_json, usage_error
from appliance.cli.standing import WITHIN, WhenStanding, Within, stand_or_exit
from rosmop.tool.tables import say_table, table_of
from rosmop.tool.terminal import printable, refusal, say

_Names = Annotated[
    list[str],
    typer.Argument(
        metavar="MONITOR",
        help="Names as in `rosrv monitor list`",
        show_default=False,
        autocompletion=completion.monitors,
    ),
]

_SHADOW = "shadow mode"
Shadow = Annotated[
    bool,
    typer.Option("--shadow", help="Shadow mode: only record what the monitors would have done"),
]
Force = Annotated[
    bool,
    typer.Option(
        "--force",
        help="Load or enforce even if this disconnects a publisher whose message type differs from the monitor's",
    ),
]


@speaks
def list_monitors(appliance: Appliance) -> None:
    """List the monitors: whether they are enabled, disabled or in shadow mode, their topics and counts.

    Example: rosrv monitor list --json
    """
    body = appliance.ask_or_exit(admin.MonitorsWanted())
    if appliance.as_json:
        for row in body.monitors:
            say_json(row)
        return
    if body.refused:
        say(f"the relay rejected them: {body.refused[0]}", "red")
    sliced = ("slices",) if any(row.slice_limit for row in body.monitors) else ()
    table = table_of(
        "monitor", "state", Column("listens to", overflow="fold"), "events", "verdicts", "drops", "changes", "faults",
        *sliced,
    )  # fmt: skip
    for row in body.monitors:
        done = (f"({row.would_drop})", f"({row.would_change})") if row.shadow else (row.drops, row.changes)
        counts = map(str, (row.events, row.verdicts, *done, row.faults))
        slices = (f"{row.slices} of {row.slice_limit}" if row.slice_limit else "",) if sliced else ()
        table.add_row(row.name, _state(row), "\n".join(row.topics + row.services), *counts, *slices)
    if body.monitors:
        say_table(table)
    else:
        say("no monitors; load some: rosrv monitor load FILE…")
    if any(row.shadow for row in body.monitors):
        say("(in brackets: messages that a monitor in shadow mode would have dropped or changed)", "dim")
    say_held({row.name: row.why_held for row in body.monitors if row.held and not row.error})
    for row in body.monitors:
        if row.error:
            held = ", and holds its topics" if row.held else ""
            fix = f"rosrv monitor load {row.file}"
            say(f"{row.name} does nothing{held}: its file has an error: {row.error}: {fix}", "red")
    source = f" ({body.folder})" if body.folder else ""
    differs = (
        "; differs from the folder (load the folder's, removing no others: rosrv monitor reload)"
        if body.folder and body.differs_from_folder
        else ""
    )
    how = f", {loaded_by(body.who, body.loaded)}" if body.revision else ""
    say(f"revision {body.revision} of the specifications{source}{how}{differs}")


@speaks
def enable(
    appliance: Appliance,
    names: _Names,
    *,
    shadow: Shadow = False,
    when_standing: WhenStanding = False,
    within: Within = WITHIN,
) -> None:
    """Enable monitors. With --shadow they only record what they would have done.

    Example: rosrv monitor enable safeTrigger --shadow
    """
    if when_standing:
        stand_or_exit(appliance, within, "rosrv monitor")
    if shadow:
        _switch(appliance, admin.MonitorShadow(names, True), _SHADOW)
    else:
        _switch(appliance, admin.MonitorSwitch(names, True), "enabled")


@speaks
def enforce(
    appliance: Appliance,
    names: _Names,
    *,
    force: Force = False,
    confirm_within: ConfirmWithin = None,
    when_standing: WhenStanding = False,
    within: Within = WITHIN,
) -> None:
    """Bring monitors from shadow mode into force. They keep their state unless they missed messages.

    With --confirm-within they return to shadow mode after this time, even if the appliance restarts.

    The output names those that start in their initial state.

    Example: rosrv monitor enforce safeTrigger
    """
    seconds = seconds_within(confirm_within, "monitor")
    if when_standing:
        stand_or_exit(appliance, within, "rosrv monitor")
    _switch(appliance, admin.MonitorShadow(names, False, force=force, confirm_within=seconds), "enabled")


@speaks
def disable(
    appliance: Appliance,
    names: _Names,
    *,
    time_off: Annotated[
        str | None,
        typer.Option("--for", help="Enable them again after this time (30s, 10m, 2h, 1d)"),
    ] = None,
) -> None:
    """Disable monitors: messages pass them unchanged, and their variables keep their values.

    With --for they are enabled again automatically, even if the appliance restarts.

    Example: rosrv monitor disable safeTrigger --for 10m
    """
    seconds = None if time_off is None else bounded_span("--for", time_off, "1s", "30d", "rosrv monitor")
    _switch(appliance, admin.MonitorSwitch(names, False, for_seconds=seconds), "disabled")


@speaks
def remove(
    appliance: Appliance,
    names: Annotated[
        list[str],
        typer.Argument(
            metavar="MONITOR",
            help="Names as in `rosrv monitor list`, or of files (.rv)",
            show_default=False,
            autocompletion=completion.monitors,
        ),
    ],
    confirm_within: ConfirmWithin = None,
) -> None:
    """Remove specifications, by the names of their monitors or files.

    Example: rosrv monitor remove safeTrigger --confirm-within 5m
    """
    order = admin.MonitorRemove(names, confirm_within=seconds_within(confirm_within, "monitor"))
    say_replaced(appliance.answer_or_exit(order))


@speaks
def reload(
    appliance: Appliance,
    prune: Annotated[
        bool, typer.Option("--prune", help="Also remove specifications that the folder lacks")
    ] = False,
    confirm_within: ConfirmWithin = None,
    *,
    shadow: Shadow = False,
    force: Force = False,
    hold: Hold = False,
    when_standing: WhenStanding = False,
    within: Within = WITHIN,
) -> None:
    """Load the folder of specifications again. Specifications that are not in it stay loaded and are listed.

    Example: rosrv monitor reload
    """
    seconds = seconds_within(confirm_within, "monitor")
    if when_standing:
        stand_or_exit(appliance, within, "rosrv monitor")
    order = admin.MonitorReload(prune=prune, confirm_within=seconds, force=force, shadow=shadow, hold=hold)
    body = appliance.answer_or_exit(order)
    say_replaced(body)
    if body.kept:
        say(f"in force but not in the folder: {', '.join(body.kept)} (--prune removes them)", "yellow")


@speaks
def resume(appliance: Appliance, names: _Names) -> None:
    """Let messages pass again on the topics that these monitors hold.

    A monitor holds its topics, for example, after it lost its state: it drops all their messages.

    Example: rosrv monitor resume safeTrigger
    """
    body = appliance.answer_or_exit(admin.MonitorResume(names))
    say(f"resumed: {', '.join(body.names) or 'none, no topic was held'}")


@speaks
def set_given(
    appliance: Appliance,
    name: Annotated[
        str,
        typer.Argument(
            metavar="MONITOR", help="Name as in `rosrv monitor list`", autocompletion=completion.monitors
        ),
    ],
    values: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="NAME=VALUE", help="Constants that are given to it, such as vMax=0.3", show_default=False
        ),
    ] = None,
    *,
    when_standing: WhenStanding = False,
    within: Within = WITHIN,
) -> None:
    """While a monitor runs, change the constants in the `given` of its specification. Without values, print all
    constants and topics.

    The monitor keeps its source and its state. A value outside its range is rejected. To change topics, use `rosrv
    monitor load --set`.

    Example: rosrv monitor set speed vMax=0.3
    """
    if values:
        order = admin.MonitorGive(name, _all_assigned(values, "NAME=VALUE"))
        if when_standing:
            stand_or_exit(appliance, within, "rosrv monitor")
        answer = appliance.answer_or_exit(order)
        given = answer.given
    else:
        rows = appliance.ask_or_exit(admin.MonitorsWanted()).monitors
        found = [row for row in rows if row.name == name]
        if not found:
            names = ", ".join(row.name for row in rows)
            known = f"there are: {names}" if names else "none is loaded"
            raise refusal([f"rosrv monitor set: no monitor is named {name}; {known}"])
        given = found[0].given
    if appliance.as_json:
        for one in given:
            say_json(one)
        return
    if not given:
        say(f"nothing is given to {name}; its source has no `given {{ … }}`")
        return
    table = table_of("given", "value", "range", "default")
    for one in given:
        bounds = "" if one.least is None else f"{one.least:g}..{one.most:g}"
        table.add_row(one.name, f"{_shown(one.value)} {one.unit}".strip(), bounds, _shown(one.default))
    say_table(table)


def _shown(value: GivenValue) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _parse_assignment(text: str, form: str) -> tuple[str, str]:
    name, sign, value = text.partition("=")
    if not sign or not name or not value:
        raise usage_error(f"{printable(text)}: write {form}", "rosrv monitor")
    return name, value


def _all_assigned(texts: list[str], form: str) -> dict[str, GivenValue]:
    found: dict[str, GivenValue] = {}
    for text in texts:
        name, value = _parse_assignment(text, form)
        if name in found:
            raise usage_error(f"{printable(name)} has two values: give one", "rosrv monitor")
        found[name] = value
    return found


def given_to_monitors(given: list[str]) -> dict[str, dict[str, GivenValue]]:
    found: dict[str, dict[str, GivenValue]] = {}
    form = "--set MONITOR.NAME=VALUE"
    for path, value in _all_assigned(given, form).items():
        monitor, dot, name = path.partition(".")
        if not dot or not name:
            raise usage_error(f"{printable(f'{path}={value}')}: write {form}", "rosrv monitor")
        found.setdefault(monitor, {})[name] = value
    return found


@speaks
def rv_state(appliance: Appliance) -> None:
    """Print what `-rvstate` of the original ROSRV prints: master ports, and the ports of each monitor's topics."""
    body = appliance.ask_or_exit(admin.MonitorsWanted())
    real, port, rows = body.rv_state
    if appliance.as_json:
        say_json(body.rv_state)
        return
    say(f"ROSMaster port {real}, RVMaster port {port}")
    for name, topic, xmlrpc, tcp in rows:
        say(f"{name} {topic} XML-RPC port {xmlrpc} TCP port {tcp}")


def _switch(appliance: Appliance, order: admin.MonitorSwitch | admin.MonitorShadow, word: str) -> None:
    body = appliance.ask_or_exit(order)
    if appliance.as_json:
        say_json({**in_full(body), "enabled": word == "enabled", "shadow": word == _SHADOW})
    else:
        _say_switched(body, word)
    write_switches(appliance, order.names)


def _say_switched(body: Switched, word: str) -> None:
    end = "" if body.until is None else f", until {moment(body.until)}"
    say(f"{word}: {', '.join(body.names) or 'no change'}{end}")
    if body.began:
        say(f"{', '.join(body.began)} started in the initial state", "yellow")
    say_shadow_deadline(body.confirm_by)


def _state(row: MonitorState) -> str:
    if row.error:
        return "broken"
    if row.shadow:
        return f"shadow mode, {row.missed} missed" if row.missed else _SHADOW
    if row.held:
        return "holds its topics"
    if row.failing:
        return "failing"
    if row.enabled:
        return (
            "enabled"
            if row.confirm_by is None
            else f"enabled until {moment(row.confirm_by)} unless confirmed"
        )
    return "disabled" if row.off_until is None else f"disabled until {moment(row.off_until)}"
