"""Make the safety manual of a robot from its guards, and the difference from an earlier one. No I/O.

The content is a function of the guards with their values and longest delays, of what is not protected, and of the
version; its digest is printed below it. The last proof tests and the counts of delays follow the signatures, and are
not part of the content.
"""

import difflib
import hashlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from appliance import __version__
from appliance.base import clock
from appliance.features.guards.evidence import (
    COMMON_CAUSES,
    EVIDENCE,
    MEANING_OF_SUMS,
    NO_SAFETY_FUNCTION,
    RELAY_MS,
    StoppingTime,
    stopping_time,
)
from appliance.features.guards.guard_answers import GuardList, GuardRow
from appliance.features.guards.guard_facts import values_of
from appliance.features.guards.guard_words import times_in_words
from appliance.features.guards.presets import PRESETS
from rosmop.tool.terminal import printable
from rosmop.types.roles import types_of_roles

_DIGEST = "Digest (SHA-256) of all lines above: "
_FOUND = re.compile(rf"^{re.escape(_DIGEST)}`([0-9a-f]{{64}})`$", re.MULTILINE)
_IDLE = {
    "off": "disabled",
    "shadow": "in shadow mode",
    "holding": "it cannot judge, and waits for an operator",
    "broken": "its file has an error, so it does nothing",
}


class NoManualError(ValueError):
    """A text is not a safety manual."""


@dataclass(frozen=True)
class Manual:
    """A manual: the content, and the state in which the robot was when it was made."""

    content: str
    state: str

    @property
    def digest(self) -> str:
        return hashlib.sha256(self.content.encode()).hexdigest()

    def text(self, changed: Sequence[str]) -> str:
        """Return the whole manual; `changed` is the difference from an earlier one."""
        difference = (
            ["## Difference from the earlier manual", "", "```diff", *changed, "```", ""] if changed else []
        )
        return "\n".join([
            f"{self.content}{_DIGEST}`{self.digest}`", "",
            "## Signatures", "",
            "| | name | date | signature |", "|---|---|---|---|", "| 1 | | | |", "| 2 | | | |", "",
            self.state, *difference,
        ])  # fmt: skip


def safety_manual(name: str, guards: GuardList, unguarded: Sequence[str]) -> Manual:
    """Return the manual of the robot with this name, which may be empty."""
    acting = [row for row in guards.guards if row.state not in _IDLE]
    sections = (
        _guards(guards.guards), _times(acting), _distances(acting),
        _listed("Not protected", [*unguarded, *guards.warnings]), _common(),
    )  # fmt: skip
    head = [f"# Safety manual of the robot{f' {name}' if name else ''}", "", NO_SAFETY_FUNCTION, "",
            f"Made by `rosrv guard manual` {__version__} from the guards of the running appliance.", ""]  # fmt: skip
    content = [*head, *(line for section in sections for line in section)]
    return Manual(_shown(content), _shown([*_state(guards.guards)]))


def _shown(parts: Sequence[str]) -> str:
    """Return the lines of these parts. Names come from nodes, so characters that change a terminal are escaped."""
    return "".join(f"{printable(line)}\n" for part in parts for line in part.split("\n"))


def changes(earlier: str, made: Manual) -> list[str]:
    """Return the lines that differ. Raises `NoManualError`."""
    match = _FOUND.search(earlier)
    if match is None:
        raise NoManualError("it has no digest of a safety manual")
    content = earlier[: match.start()]
    before = hashlib.sha256(content.encode()).hexdigest()
    lines = [
        *difflib.unified_diff(
            content.splitlines(), made.content.splitlines(), before, made.digest, "", "", 1, ""
        )
    ]
    if before != match[1]:
        lines.insert(0, f"the earlier manual was edited: it names the digest {match[1]}")
    return lines


def _guards(rows: Sequence[GuardRow]) -> Iterator[str]:
    yield from ("## Guards", "")
    if not rows:
        yield from ("No guard is loaded.", "")
    for row in rows:
        known = EVIDENCE.get(row.preset)
        yield from (f"### {row.name}", "")
        yield f"- preset: {row.preset} {row.version}{_ORIGINS.get(row.origin, '')}, digest `{row.digest}`"
        if row.state in _IDLE:
            yield f"- **not in force**: {_IDLE[row.state]}"
        yield f"- topics: {', '.join(f'{name} {topic}' for name, topic in row.topics.items())}"
        yield from _values(row)
        if known is not None:
            yield f"- effect: {PRESETS[row.preset].what}"
            yield f"- it notices: {known.notices}"
            yield f"- assumed of the robot: {'; '.join(known.assumed) or 'nothing beyond the common causes'}"
            yield f"- fails without a notice: {'; '.join(known.fails)}"
            yield f"- followed, not claimed: {'; '.join(known.clauses)}"
        yield ""


_ORIGINS = {
    "older": " (an older version: rosrv guard upgrade)",
    "changed": " (changed: not the text of the preset)",
}


def _values(row: GuardRow) -> Iterator[str]:
    units = {one.name: one.unit for one in row.given}
    for name, value in (values_of(row.given) | row.loads).items():
        below = next((one.partition(" is ")[2] for one in row.below if one.startswith(f"{name}=")), "")
        yield f"- `{name}` = {value} {units.get(name, '')}".rstrip() + (f": **{below}**" if below else "")


def _time_of(row: GuardRow) -> StoppingTime | None:
    """Return the time to stop, or None if the text of the guard is not that of a preset of this version."""
    if row.origin != "current" or row.preset not in EVIDENCE:
        return None
    return stopping_time(PRESETS[row.preset], values_of(row.given) | row.loads, _relay(row))


def _relay(row: GuardRow) -> float:
    """Return the milliseconds of the relay; measured ones count as `relay.late` at least, which raises no alarm."""
    return RELAY_MS if row.times is None else max(row.times.limit, row.times.latest) * 1e3


def _times(rows: Sequence[GuardRow]) -> Iterator[str]:
    yield from ("## Time to stop", "")
    yield from ("From the cause to the stop at the base, at worst.", "", MEANING_OF_SUMS, "")
    yield (
        "The relay's part is *measured* where this appliance has measured it: the longest delay, or `relay.late`, up to"
        " which a delay raises no alarm. Otherwise it is *declared*: the slowest of 1,000 stops on a busy machine,"
        f" {RELAY_MS} ms. Add the sensor's own delay, and the time in which the base stands after the stop."
    )
    yield from ("", "| guard | silence | timer | relay | sum |", "|---|---|---|---|---|")
    for row in rows:
        time = _time_of(row)
        if time is None:
            yield f"| {row.name} | not known: its text is not that of the preset | | | |"
            continue
        silence = f"`{EVIDENCE[row.preset].silence}`, {time.silence:g} ms" if time.silence else "-"
        relay = f"{time.relay:.0f} ms, {'declared' if row.times is None else 'measured'}"
        total = "never by silence: it is off" if time.total is None else f"{time.total:.0f} ms"
        yield f"| {row.name} | {silence} | {f'{time.tick} ms' if time.tick else '-'} | {relay} | {total} |"
    yield ""


def _distances(rows: Sequence[GuardRow]) -> Iterator[str]:
    """Yield how far a base drives in the time to stop, at the velocity that a guard permits."""
    yield from ("## Distances", "")
    velocities = types_of_roles()["Velocity"]
    by_topic: dict[str, list[GuardRow]] = {}
    for row in rows:
        if row.types.get("command") in velocities:
            by_topic.setdefault(row.topics["command"], []).append(row)
    if not by_topic:
        yield from ("No guard in force judges a velocity.", "")
    for topic, found in by_topic.items():
        limits = [float(values_of(row.given)["vMax"]) for row in found if row.preset == "speed"]
        v = min(limits, default=1.0)
        why = "the limit of `speed`" if limits else "for each 1 m/s, because no guard `speed` limits it"
        yield from (f"{topic}, at {v:g} m/s ({why}); {_braking(found)[1]}:", "")
        yield from ("| guard | until the stop is at the base | until the base stands |", "|---|---|---|")
        braking = _braking(found)[0]
        for row in found:
            time = _time_of(row)
            if time is None or time.total is None:
                yield f"| {row.name} | not known | not known |"
                continue
            way = v * time.total / 1e3
            stands = "not known" if braking is None else f"{way + v * braking[0] + v * v * braking[1]:.2f} m"
            yield f"| {row.name} | {way:.2f} m | {stands} |"
        yield ""


def _braking(rows: Sequence[GuardRow]) -> tuple[tuple[float, float] | None, str]:
    """Return what the values declare of the base: seconds before it brakes, and metres for each (m/s)²."""
    by_preset = {row.preset: values_of(row.given) for row in rows}
    if (found := by_preset.get("separation")) is not None:
        reaction, braking = float(found["reaction"]), float(found["braking"])
        declared = f"the base brakes with {braking:g} m/s2 after {reaction:g} s, as `separation` declares"
        return (reaction, 1 / (2 * braking)), declared
    if (found := by_preset.get("fence")) is not None:
        ahead = float(found["ahead"])
        return (ahead, 0.0), f"the base stops within the way of {ahead:g} s, as `fence` declares"
    return None, "no value declares how the base brakes"


def _listed(title: str, lines: Sequence[str]) -> Iterator[str]:
    yield from (f"## {title}", "")
    yield from (f"- {line}" for line in lines)
    yield ""


def _common() -> Iterator[str]:
    yield from ("## Common causes", "", "These make several guards fail together.", "")
    yield from ("| cause | effect | what remains |", "|---|---|---|")
    for cause, effect, remains in COMMON_CAUSES:
        yield f"| {cause} | {effect} | {_LINK.sub(_TEXT, remains)} |"
    yield ""


_LINK, _TEXT = re.compile(r"\[([^\]]*)\]\([^)]*\)"), r"\1"
"""A link of the evidence page, to a page that the manual does not have beside it."""


def _state(rows: Sequence[GuardRow]) -> Iterator[str]:
    yield from ("## State when it was made", "")
    yield f"{_minute(clock.wall())}. This part changes automatically, and is not in the digest."
    yield ""
    for row in rows:
        yield f"- {row.name}: {_proof(row)}"
        if row.times is not None:
            yield f"- {row.name}: {times_in_words(row.times)}"


def _proof(row: GuardRow) -> str:
    test = row.tested
    if test is None:
        return "never tested: rosrv guard test"
    other = "" if test.digest == row.digest else " **The guard was changed since then: test it again.**"
    arrived = ", ".join(one.node for one in test.reached if one.driver and one.acknowledged is not None)
    missed = "no stop was sent" if test.outcome in ("passed", "undecided") else "the stop reached no driver"
    stop = f"the TCP of {arrived} acknowledged the stop" if arrived else test.not_sent or missed
    return f"last proof test {_minute(test.at)}: {test.in_words()}; {stop}.{other}"


def _minute(seconds: float) -> str:
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%MZ}"
