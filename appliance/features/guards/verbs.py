"""The commands `rosrv guard list|new|set|enforce|upgrade|remove`."""

import shlex
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from appliance.base.counted import counted
from appliance.channel import admin
from appliance.channel.answers.monitor_answers import Monitors, MonitorState, Replaced, Replacement
from appliance.channel.messages import GivenValue
from appliance.cli import completion
from appliance.cli.commit_confirm import ConfirmWithin, seconds_within
from appliance.cli.connection.admin_client import NotRunningError
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.durations import time_given
from appliance.cli.monitor_changes import (
    Hold,
    folder_of,
    say_obstacle,
    say_replaced,
    say_shadow_deadline,
    write_specification,
    write_switches,
)
from appliance.cli.output import refuse_beside_dry_run, say_json, say_row, usage_error
from appliance.cli.standing import WITHIN, WhenStanding, Within, stand_or_exit
from appliance.features.guards.guard_answers import GuardList, GuardRow
from appliance.features.guards.guard_facts import preset_row, values_of
from appliance.features.guards.guard_words import (
    afresh_in_words,
    origin_in_words,
    state_in_words,
    times_in_words,
)
from appliance.features.guards.presets import (
    PRESETS,
    GuardError,
    Preset,
    description_of,
    file_of,
    former_guard,
    is_former,
    preset_of,
    unknown_guard,
    with_values,
)
from appliance.features.guards.requests import (
    GuardNew,
    GuardsWanted,
    GuardTry,
    GuardUpgrade,
)
from appliance.features.guards.upgrades import same
from appliance.features.table import verb_function
from rosmop.tool.tables import say_table, table_of
from rosmop.tool.terminal import say

_VERB = "rosrv guard"
GuardName = Annotated[
    str,
    typer.Argument(
        metavar="GUARD",
        help="Name as in `rosrv guard list`",
        autocompletion=completion.monitors,
        show_default=False,
    ),
]
CommandTopic = Annotated[
    str,
    typer.Argument(
        metavar="TOPIC",
        help="The topic of the commands, such as /cmd_vel",
        autocompletion=completion.topics,
        show_default=False,
    ),
]
_VALUES = typer.Argument(
    metavar="PARAMETER=VALUE",
    help="Parameters of the preset, such as silent=0.5; `rosrv guard list` prints their units",
    show_default=False,
)
_DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Only report what would be loaded, changed and held")
]


@speaks
def list_guards(appliance: Appliance) -> None:
    """List the guards of the running appliance, and the presets with their parameters.

    Example: rosrv guard list
    """
    if appliance.said or _runs(appliance):
        _list_loaded(appliance, appliance.ask_or_exit(GuardsWanted()))
    for preset in PRESETS.values():
        if appliance.as_json:
            say_json(preset_row(preset))
        else:
            _say_preset(preset)


def _list_loaded(appliance: Appliance, body: GuardList) -> None:
    for row in body.guards:
        if appliance.as_json:
            held, shadow, on = (row.state == state for state in ("holding", "shadow", "off"))
            say_json({"guard": row.name, "preset": row.preset, "state": row.state, "shadow": shadow,
                      "enabled": not shadow and not on, "held": held, "topics": [*row.topics.values()],
                      "stops": row.stops, "confirm_by": row.confirm_by, "version": row.version,
                      "origin": row.origin, "afresh": row.afresh, "below": row.below,
                       "digest": row.digest, "error": row.error, "last_stop": msgspec.to_builtins(row.last_stop),
                       "times": row.times, "tested": row.tested})  # fmt: skip
        else:
            about = f"guard {row.name}: {origin_in_words(row)} on {', '.join(row.topics.values())},"
            say_row([about, state_in_words(row)], gap=" ")
            if row.times is not None:
                say(f"    {times_in_words(row.times)}")
            for value in filter(None, [*row.below, afresh_in_words(row)]):
                say(f"    {value}", "yellow")
    for warning in body.warnings:
        if appliance.as_json:
            say_json({"warning": warning})
        else:
            say(warning, "yellow")
    if not appliance.as_json:
        say("the presets for further guards:" if body.guards else "no guard is loaded; the presets:", "bold")


@speaks
def new(
    appliance: Appliance,
    preset: Annotated[
        str,
        typer.Argument(
            metavar="PRESET",
            help="Kind of guard: `rosrv guard list` prints all, with their parameters",
            show_default=False,
        ),
    ],
    topic: CommandTopic,
    values: Annotated[list[str] | None, _VALUES] = None,
    *,
    by: Annotated[
        str | None,
        typer.Option(
            "--by",
            metavar="TOPIC",
            help="Topic of the sensor, if the preset needs one",
            autocompletion=completion.topics,
        ),
    ] = None,
    further: Annotated[
        list[str] | None,
        typer.Option(
            "--topic",
            metavar="NAME=TOPIC",
            help="Another topic of the preset; NAME as in `rosrv guard list` (repeatable)",
        ),
    ] = None,
    kinds: Annotated[
        list[str] | None,
        typer.Option(
            "--type",
            metavar="NAME=TYPE",
            help="Type of a topic that no node has yet, such as command=geometry_msgs/Twist (repeatable)",
        ),
    ] = None,
    name: Annotated[
        str | None, typer.Option("--name", help="Name of the guard (default: the preset's)")
    ] = None,
    shadow: Annotated[
        bool, typer.Option("--shadow", help="Only record what the guard would have done")
    ] = False,
    confirm_within: ConfirmWithin = None,
    when_standing: WhenStanding = False,
    within: Within = WITHIN,
    hold: Hold = False,
    dry_run: _DryRun = False,
) -> None:
    """Make a guard from a preset and load it. Its file is also written into the folder of specifications.

    The robot must have the topics, with types that the preset knows; --type is for a topic that no node has yet. With
    --confirm-within, and over REST, no file is written.

    Example: rosrv guard new deadman /cmd_vel --shadow silent=0.5
    """
    named = [f"command={topic}", *([] if by is None else [f"by={by}"])]
    topics = _pairs([*named, *(further or [])], "--topic NAME=TOPIC")
    given, types = _pairs(values, "PARAMETER=VALUE"), _pairs(kinds, "--type NAME=TYPE")
    guard = name or preset
    confirmed = seconds_within(confirm_within, "guard")
    if dry_run:
        refuse_beside_dry_run(_VERB, confirm_within=confirmed, when_standing=when_standing)
        _plan(appliance, GuardTry(preset, topics, types, guard, given, shadow, hold=hold))
        return
    if when_standing:
        stand_or_exit(appliance, within, _VERB)
    body = appliance.ask_or_exit(
        GuardNew(preset, topics, given, types, guard, shadow, confirm_within=confirmed, hold=hold)
    )
    _say_changed(appliance, body)
    _write(appliance, guard, temporary=body.confirm_by is not None)


@speaks
def set_values(
    appliance: Appliance,
    name: GuardName,
    values: Annotated[list[str], _VALUES],
    *,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="Only report what would be loaded, changed and held, and which messages of the flight recorder the"
            " guard would have stopped",
        ),
    ] = False,
    since: Annotated[
        str | None,
        typer.Option(
            "--since",
            help="With --dry-run: from this time: 1h (ago; the default), 14:03, a date, or RFC 3339",
            show_default=False,
        ),
    ] = None,
    when_standing: WhenStanding = False,
    within: Within = WITHIN,
    hold: Hold = False,
) -> None:
    """Set parameters of a guard while it runs. It keeps its state, but starts again after a change of joint limits,
    of deadlines or of named entries.

    Example: rosrv guard set fence margin=0.5
    """
    wanted = _pairs(values, "PARAMETER=VALUE")
    if dry_run:
        refuse_beside_dry_run(_VERB, when_standing=when_standing)
        time_given("--since", since or "1h", _VERB)
    elif since is not None:
        raise usage_error("--since goes with --dry-run: give both, or neither", _VERB)
    loaded, row, text = _guard(appliance, name)
    preset = preset_of(text)
    assert preset is not None  # noqa: S101  `_guard` checks it
    checked = {each: preset.parameter(each).check(value) for each, value in wanted.items()}
    if dry_run:
        _plan(appliance, GuardTry(name=name, values=wanted, hold=hold))
        _replay(appliance, row, with_values(text, _in_force(row, preset) | checked), since or "1h")
        return
    if when_standing:
        stand_or_exit(appliance, within, _VERB)
    in_text = {each: value for each, value in checked.items() if preset.parameter(each).loads}
    constants: dict[str, GivenValue] = {each: value for each, value in checked.items() if each not in in_text}
    if in_text:
        changed = with_values(text, in_text)
        order = admin.MonitorReplace(
            name, changed, note=description_of(changed), shadow=row.shadow, hold=hold, given=constants
        )
        _say_changed(appliance, appliance.ask_or_exit(order))
        write_specification(appliance, loaded, row, changed)
    elif constants:
        answer = appliance.answer_or_exit(admin.MonitorGive(name, constants))
        say(
            f"{name}: set {', '.join(f'{each}={constants[each]}' for each in answer.changed) or 'no difference'}"
        )


@speaks
def enforce(
    appliance: Appliance,
    name: GuardName,
    *,
    confirm_within: ConfirmWithin = None,
    when_standing: WhenStanding = False,
    within: Within = WITHIN,
    dry_run: _DryRun = False,
) -> None:
    """Bring a guard from shadow mode into force. It keeps its state, unless it missed messages in shadow mode.

    With --confirm-within it returns to shadow mode after this time unless you run `rosrv monitor confirm`.

    Example: rosrv guard enforce fence --confirm-within 5m
    """
    confirmed = seconds_within(confirm_within, "guard")
    if dry_run:
        refuse_beside_dry_run(_VERB, confirm_within=confirmed, when_standing=when_standing)
        _plan(appliance, GuardTry(name=name, enforce=True))
        return
    _guard(appliance, name)
    order = admin.MonitorShadow([name], False, confirm_within=confirmed)
    if when_standing:
        stand_or_exit(appliance, within, _VERB)
    body = appliance.ask_or_exit(order)
    if appliance.as_json:
        say_json(body)
    else:
        say(f"in force: {', '.join(body.names) or 'no change'}")
        if body.began:
            say(f"{', '.join(body.began)} started in the initial state", "yellow")
        say_shadow_deadline(body.confirm_by)
    write_switches(appliance, [name])


@speaks
def upgrade(
    appliance: Appliance,
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="GUARD",
            help="Name as in `rosrv guard list` (default: all guards of an older version)",
            autocompletion=completion.monitors,
            show_default=False,
        ),
    ] = None,
    *,
    further: Annotated[
        list[str] | None,
        typer.Option(
            "--topic", metavar="NAME=TOPIC", help="A topic that the present preset also needs (repeatable)"
        ),
    ] = None,
    confirm_within: ConfirmWithin = None,
    when_standing: WhenStanding = False,
    within: Within = WITHIN,
    hold: Hold = False,
    dry_run: _DryRun = False,
) -> None:
    """Replace guards of an older version with new ones from the present presets. Topics and values stay the same.

    Each guard starts without its state: the base is stopped until the next command. A guard whose value or topic the
    present version rejects is named and stays as it is; all others are upgraded. --topic and --confirm-within need a
    GUARD.

    Example: rosrv guard upgrade --dry-run
    """
    confirmed, refused = seconds_within(confirm_within, "guard"), False
    if dry_run:
        refuse_beside_dry_run(_VERB, confirm_within=confirmed, when_standing=when_standing)
    if name is None:
        option = "--confirm-within" if confirmed is not None else "--topic" if further else ""
        if option:
            raise GuardError(f"{option} is for one guard: name it; see rosrv guard list")
        names = [row.name for row in appliance.ask_or_exit(GuardsWanted()).guards if row.origin == "older"]
        if not names and not appliance.as_json:
            say("no guard has an older version")
    else:
        names = [name]
    topics = _pairs(further, "--topic NAME=TOPIC")
    if when_standing and names:
        stand_or_exit(appliance, within, _VERB)
    for each in names:
        try:
            if dry_run:
                _plan(appliance, GuardTry(name=each, topics=topics, upgrade=True, hold=hold))
            else:
                _upgrade(appliance, GuardUpgrade(each, topics, confirm_within=confirmed, hold=hold))
        except typer.Exit as end:
            if end.exit_code != 1:
                raise
            refused = True
    if refused:
        raise typer.Exit(1)


def _upgrade(appliance: Appliance, order: GuardUpgrade) -> None:
    body = appliance.ask_or_exit(order)
    _say_changed(appliance, body)
    _write(appliance, order.name, temporary=body.confirm_by is not None)


def _write(appliance: Appliance, name: str, *, temporary: bool) -> None:
    loaded = appliance.ask_or_exit(admin.MonitorsWanted(texts=True))
    row = next(row for row in loaded.monitors if row.name == name)
    write_specification(appliance, loaded, row, (loaded.files or {})[row.file], temporary=temporary)


@speaks
def remove(appliance: Appliance, name: GuardName, confirm_within: ConfirmWithin = None) -> None:
    """Remove a guard, and its file from the folder of specifications.

    With --confirm-within, and over REST, the file stays: a reload of the folder loads the guard again.

    Example: rosrv guard remove fence
    """
    confirmed = seconds_within(confirm_within, "guard")
    loaded, row, _text = _guard(appliance, name)
    guard = next(one for one in appliance.ask_or_exit(GuardsWanted()).guards if one.name == name)
    order = admin.MonitorRemove([name], confirm_within=confirmed)
    body = appliance.ask_or_exit(order)
    _say_changed(appliance, body)
    if not appliance.as_json and body.confirm_by is None:
        say(f"undo: {_undo(guard)}")
    folder = folder_of(appliance, loaded)
    if folder and body.confirm_by is None:
        path = file_of(row.file.removesuffix(".rv"), folder)
        try:
            if path.exists():  # on a read-only mount, the removal of a missing file also fails
                path.unlink()
        except OSError as error:
            why = f"{path} is not removed: {error.strerror}; a reload of the folder loads the guard again"
            say_obstacle(appliance, why)


def _undo(guard: GuardRow) -> str:
    """Return the command that makes a removed guard again, in its initial state, or in shadow mode if it did not act
    for good.
    """
    if guard.origin != "current":
        return "rosrv monitor rollback"
    defaults = {
        parameter.name: parameter.default for parameter in PRESETS[guard.preset].parameters
    }  # those of the text are its values
    constants = {
        name: value for name, value in values_of(guard.given).items() if not same(value, defaults[name])
    }
    topics = dict(guard.topics)
    words = ["rosrv", "guard", "new", guard.preset, topics.pop("command")]
    words += [f"{name}={value}" for name, value in (constants | guard.loads).items()]
    words += ["--by", by] if (by := topics.pop("by", "")) else []
    words += [word for name, topic in topics.items() for word in ("--topic", f"{name}={topic}")]
    words += [word for name, kind in guard.types.items() for word in ("--type", f"{name}={kind}")]
    words += ["--name", guard.name] if guard.name != guard.preset else []
    words += ["--shadow"] if guard.state in ("shadow", "off") or guard.confirm_by is not None else []
    return shlex.join(words)


def _runs(appliance: Appliance) -> bool:
    try:
        return appliance.ask(admin.MonitorsWanted()).ok
    except NotRunningError:
        return False


def _pairs(texts: list[str] | None, form: str) -> dict[str, str]:
    pairs: dict[str, str] = {}
    for text in texts or []:
        name, sign, value = text.partition("=")
        if not sign or not name or not value:
            raise GuardError(f"{text}: write {form}")
        if name in pairs:
            raise GuardError(f"{name} has two values, {pairs[name]} and {value}: give one")
        pairs[name] = value
    return pairs


def _guard(appliance: Appliance, name: str) -> tuple[Monitors, MonitorState, str]:
    loaded = appliance.ask_or_exit(admin.MonitorsWanted(texts=True))
    texts = loaded.files or {}
    guards = {row.name: row for row in loaded.monitors if preset_of(texts.get(row.file, ""))}
    if name not in guards:
        file = next((row.file for row in loaded.monitors if row.name == name), "")
        former = is_former(texts.get(file, ""))
        raise GuardError(former_guard(name, file) if former else unknown_guard(name, guards))
    return loaded, guards[name], texts[guards[name].file]


def _in_force(row: MonitorState, preset: Preset) -> dict[str, str]:
    names = {parameter.name for parameter in preset.parameters}
    return {name: value for name, value in values_of(row.given).items() if name in names}


def _say_changed(appliance: Appliance, body: Replaced | Replacement) -> None:
    if appliance.as_json:
        say_json(body)
    else:
        say_replaced(body, "rosrv guard enforce")


def _plan(appliance: Appliance, request: GuardTry) -> None:
    plan = appliance.ask_or_exit(request)
    if appliance.as_json:
        say_json(plan)
    else:
        how = "in shadow mode" if plan.shadow else "disabled" if plan.off else "in force"
        if plan.file:
            state = "begin in its initial state" if plan.begins else "keep its state"
            say(f"would load {plan.file}; {plan.name} would {state}, {how}")
        elif plan.changed:
            say(f"would load nothing; {plan.name} would keep its state, {how}")
        elif request.enforce:
            say(
                f"would load nothing; {plan.name} would be {how}; it would have acted"
                f" {counted(plan.stops, 'time')} before"
            )
        else:
            say("would change nothing")
        for name, (before, after) in plan.changed.items():
            say(f"would set {name}={after}{f', now {before}' if before else ''}")
        say(f"topics: {', '.join(f'{name}={topic}' for name, topic in plan.acts.items())}")
        for line in plan.warnings:
            say(line, "yellow")
        for line in plan.refused:
            say(f"would be refused: {line}", "red")
    if plan.refused:
        raise typer.Exit(1)


def _replay(appliance: Appliance, row: MonitorState, text: str, since: str) -> None:
    replay = verb_function("monitor", "replay")
    if replay is None:
        say(
            "this appliance cannot replay recordings: messages that it would have stopped are not listed",
            "yellow",
        )
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / row.file
        path.write_text(text, encoding="utf-8")
        with suppress(typer.Exit):  # the replay has printed why it ended; the plan holds
            replay.function(appliance, str(path), since=since)


def _say_preset(preset: Preset) -> None:
    say(f"{preset.name}: {preset.what}")
    for given, types in preset.topics.items():
        say(f"    {given}: {', '.join(types)}", "dim")
    if preset.parameters:
        table = table_of("    parameter", "default", "range", "meaning")
        for one in preset.parameters:
            span = f"{one.least}..{one.most}" if one.least else ""
            safe = f"; safe: {one.safe.removeprefix('== ')}" if one.safe else ""
            table.add_row(f"    {one.name}", f"{one.default} {one.unit}".strip(), span, one.what + safe)
        say_table(table)
