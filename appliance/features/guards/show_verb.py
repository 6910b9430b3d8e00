"""The command `rosrv guard show`."""

import re

from appliance.channel import admin
from appliance.channel.answers.monitor_answers import MonitorReadout
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.output import say_json, say_row
from appliance.features.guards.guard_answers import GuardRow
from appliance.features.guards.guard_words import origin_in_words, state_in_words
from appliance.features.guards.requests import GuardsWanted
from appliance.features.guards.verbs import GuardName
from rosmop.tool.tables import add_row, say_table, table_of
from rosmop.tool.terminal import refusal, say

_REMARK = re.compile(r"^ {4}(\w.*?;) +// (.+)$", re.MULTILINE)
_NAME = re.compile(r"\b([A-Za-z_]\w*)(?:\[[^]]*\])?\s*(?:=[^,;]*)?[,;]")
_FIRST_TIME, _LAST_TIME = 1e9, 1e10
"""Numbers between them are times of the monitors' clock: seconds since 1970."""


@speaks
def show(
    appliance: Appliance,
    name: GuardName,
) -> None:
    """Show a guard: whether it is in force, its parameters, and the values on which it decides now.

    The audit log records who looked, because the values come from messages.

    Example: rosrv guard show fence
    """
    guards = appliance.ask_or_exit(GuardsWanted(presets=False)).guards
    row = next((guard for guard in guards if guard.name == name), None)
    if row is None:
        known = ", ".join(guard.name for guard in guards) or "none is loaded"
        raise refusal([f"no guard is named {name}; there are: {known}"])
    found = appliance.ask_or_exit(admin.MonitorValuesWanted(name))
    if appliance.as_json:
        say_json({"guard": row, "values": found.values, "ages": found.ages, "age_seconds": found.age_seconds,
                  "why_old": found.why_old, "now_seconds": found.now_seconds})  # fmt: skip
        return
    loaded = appliance.ask_or_exit(admin.MonitorsWanted(texts=True))
    _say_guard(row)
    _say_values(found, remarks((loaded.files or {}).get(row.file, "")))


def remarks(text: str) -> dict[str, str]:
    """Return the remark behind the declaration of each variable of a specification."""
    found: dict[str, str] = {}
    for line in _REMARK.finditer(text):
        for name in _NAME.findall(line[1]):
            found.setdefault(name, line[2])
    return found


def _say_guard(row: GuardRow) -> None:
    say(f"{row.name}: {origin_in_words(row)} on {', '.join(row.topics.values())}", "bold")
    say_row([state_in_words(row)])
    for value in row.below:
        say(value, "yellow")
    given = [f"{one.name} = {one.value} {one.unit}".rstrip() for one in row.given if one.kind != "topic"]
    given += [f"{name} = {value}" for name, value in row.loads.items()]
    for line in given:
        say(f"    {line}", "dim")


def _say_values(readout: MonitorReadout, meanings: dict[str, str]) -> None:
    if readout.age_seconds is None:
        say(f"its present values are not known: {readout.why_old}", "yellow")
        return
    if readout.why_old:
        say(f"its values {readout.age_seconds:.1f} s ago; {readout.why_old}:", "yellow")
    else:
        say("its present values:")
    table = table_of("    value", "", "meaning")
    for name, value in readout.values.items():
        add_row(table, f"    {name}", _shown(value, readout.now_seconds), meanings.get(name, ""))
    say_table(table)
    for event, past in readout.ages.items():
        say(f"    {event}: {'never' if past is None else f'{past:.2f} s ago'}")


def _shown(value: object, now: float | None) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(repr(one) if isinstance(one, str) else _shown(one, now) for one in value)}]"
    if not isinstance(value, float):
        return str(value)
    if now is None or not _FIRST_TIME <= value < _LAST_TIME:
        return f"{value:.6g}"
    return f"in {value - now:.2f} s" if value > now else f"{now - value:.2f} s ago"
