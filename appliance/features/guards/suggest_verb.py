"""The command `rosrv guard suggest`."""

import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated

import typer

from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.output import say_json
from appliance.features.guards.guard_answers import Suggestion, Suggestions
from appliance.features.guards.presets import PRESETS, Guard, text_of
from appliance.features.guards.requests import GuardSuggestionsWanted
from appliance.features.table import recorded_messages
from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import MessageSender
from rosmop.tool.last_messages import last_messages
from rosmop.tool.terminal import say
from roswire.standard import standard_definitions

# Compute what the last recorded scans would permit, by running a guard's own text on them in the engine.
#
# A copy of the guard gets the scans at their times, as messages of one node, and then a fast command straight ahead.
# The part of that command that passes is permitted.

SCAN = "sensor_msgs/LaserScan"
WITHOUT: Mapping[str, Mapping[str, str]] = {"separation": {"person": "0"}}
"""The presets that limit a velocity by a scan, with the values whose effect is also shown."""
MAX_SCANS = 6
"""The interval of the scans counts, and it is known after a few."""
_FAST = 100.0
_VELOCITY = struct.Struct("<6d")


Scans = Sequence[tuple[int, bytes]]
"""Times in nanoseconds, with messages."""


def permitted_velocity(preset: str, values: Mapping[str, str], scans: Scans) -> float | None:
    """Return the velocity straight ahead, in m/s, that a guard would let pass right after the last scan.

    None: the last of the scans is not a valid message.
    """
    topics = {"command": "/command", "by": "/scan"}
    types = {"command": "geometry_msgs/Twist", "by": SCAN}
    text = text_of(Guard("guard", PRESETS[preset], topics, types, values))
    monitors = MonitorSet.of(compiled_from({"guard.rv": text}, standard_definitions(), lints=False))
    monitors.start(scans[0][0])
    for time, data in scans:
        outcome = monitors.process("/scan", bytearray(data), time, MessageSender(1))
    if outcome.faults:
        return None
    command = bytearray(_VELOCITY.pack(_FAST, 0, 0, 0, 0, 0))
    passed = monitors.process("/command", command, scans[-1][0], MessageSender(2))
    return 0.0 if passed.result == "dropped" else float(_VELOCITY.unpack_from(passed.buffer)[0])


_SINCE = "5s"


@speaks
def suggest(
    appliance: Appliance,
    *,
    with_scan: Annotated[
        bool,
        typer.Option(
            "--with-scan",
            help="Also print what the last recorded scan would permit, from the flight recorder",
        ),
    ] = False,
) -> None:
    """Propose guards for the topics of the running robot, as commands to paste, and list what is not protected.

    Nothing changes.

    Values in the commands come from the present rates of topics; all others are defaults. `--with-scan` reads the
    scans of the last five seconds from the flight recorder: over REST this needs the role of an investigator.

    Example: rosrv guard suggest
    """
    found = appliance.ask_or_exit(GuardSuggestionsWanted())
    by_scan = [suggestion for suggestion in found.suggestions if with_scan and suggestion.preset in WITHOUT]
    (_put if appliance.as_json else _print)(found)
    if by_scan:
        _say_permitted(appliance, by_scan)
    elif with_scan and not appliance.as_json:
        say(f"no proposed guard limits a velocity by a scan ({', '.join(WITHOUT)})")
    if found.not_protected and not appliance.as_json:  # an older appliance does not know it
        say("not protected:", "yellow")
    for sentence in found.not_protected:
        if appliance.as_json:
            say_json({"not_protected": sentence})
        else:
            say(f"    {sentence}")


def _put(found: Suggestions) -> None:
    for guard in found.loaded:
        say_json({"loaded": guard.name, "preset": guard.preset, "topics": guard.topics})
    for one in found.suggestions:
        say_json({"preset": one.preset, "name": one.name, "topics": one.topics, "measured": one.measured,
                  "values": one.values, "command": one.command, "others": one.others})  # fmt: skip
    for sentence in found.left_out:
        say_json({"left_out": sentence})


def _print(found: Suggestions) -> None:
    for guard in found.loaded:
        say(f"loaded: {guard.name} ({guard.preset} on {guard.topics['command']})", "green")
    for suggestion in found.suggestions:
        _say_suggestion(suggestion)
    for sentence in found.left_out:
        say(sentence, "yellow")
    if not (found.suggestions or found.loaded):
        say(
            "no topic now commands a base or an arm: start the robot's nodes, or name a topic:"
            " rosrv guard new --help"
        )


def _say_suggestion(one: Suggestion) -> None:
    set_by = {**one.measured, **one.values}
    rest = ", ".join(f"{parameter.name}={parameter.default}" for parameter in PRESETS[one.preset].parameters
                     if parameter.name not in set_by and parameter.name != "limits")  # fmt: skip
    notes = [
        f"from the current rate: {', '.join(one.measured)}" if one.measured else "",
        f"check these defaults: {rest}" if rest else "",
        *(f"instead of {one.topics[name]}: {', '.join(topics)}" for name, topics in one.others.items()),
    ]
    say(one.command)
    say(f"    {one.what}", "dim")
    say(f"    {'; '.join(filter(None, notes))}", "dim")


def _say_permitted(appliance: Appliance, guards: Sequence[Suggestion]) -> None:
    topics = [guard.topics["by"] for guard in guards]
    scans, why_not = _scans(appliance, topics)
    for guard in guards:
        topic = guard.topics["by"]
        row = {"scan": topic, "guard": guard.name}
        recorded = scans.get(topic, [])
        why = why_not or (
            "" if recorded else f"{topic} has no scan in the last {_SINCE} of the flight recorder"
        )
        permits = dict(_permits(guard, recorded)) if recorded else {}
        if recorded and permits[""] is None:
            why = f"the last message of {topic} is not a valid scan: {guard.preset} would stop the base"
        if appliance.as_json:
            say_json({**row, "unknown": why} if why else {**row, "permits": permits})
        elif why:
            say(f"{guard.name}: what it would permit is not known: {why}", "yellow")
        else:
            say(f"{guard.name}: {_sentence(topic, permits)}")


def _scans(appliance: Appliance, topics: Sequence[str]) -> tuple[Mapping[str, Scans], str]:
    recorded = recorded_messages()
    if recorded is None:
        return {}, "this appliance has no flight recorder"
    types = dict.fromkeys(topics, SCAN)
    try:
        with recorded(appliance, _SINCE, None, types) as (spans, _own):
            return last_messages(spans, types, MAX_SCANS), ""
    except typer.Exit:  # no recording of the topic; the reason has been printed
        return {}, "the flight recorder has no scan"


def _permits(suggestion: Suggestion, scans: Scans) -> Iterator[tuple[str, float | None]]:
    """Yield what the guard would permit with its own values (no name), and with each of the less safe ones."""
    values = {**suggestion.measured, **suggestion.values}
    yield "", permitted_velocity(suggestion.preset, values, scans)
    for name, value in WITHOUT[suggestion.preset].items():
        yield f"{name}={value}", permitted_velocity(suggestion.preset, {**values, name: value}, scans)


def _sentence(topic: str, permits: dict[str, float | None]) -> str:
    own, *others = permits.items()
    text = f"the present scan of {topic} permits {own[1]:.2f} m/s forward"
    return text + "".join(
        f"; {name} would permit {speed:.2f} m/s, below the standard" for name, speed in others
    )
