"""Generate docs/reference/generated/guards-evidence.md.

It is made from the presets, from the table of proofs in docs/dev/assurance.md, from the last long run of the
simulated worlds (`lab/closed_loop/results.json`), and from the rows below.
"""

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from appliance.features.guards.evidence import text_digest
from appliance.features.guards.presets import PRESETS, Preset
from distribution.checkout import BuildError
from lab.closed_loop.results import Row, Rows, parsed, present_digests
from lab.closed_loop.worlds import NOT_MODELLED, PAIRS, WORLDS, at_most

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "lab/closed_loop/results.json"
ASSURANCE = ROOT / "docs/dev/assurance.md"
RELAY_MS = 68
"""The longest of 1,000 measured times from the end of `silent` to a stop at the base, on a busy machine."""

_TICK = re.compile(r"event tick\(\) every (\d+)ms")


@dataclass(frozen=True)
class Evidence:
    """The facts about a preset that an assessor needs beyond its text."""

    clauses: tuple[str, ...]
    """Edition and clause of the standards that it follows in part, for vehicles ISO 3691-4 first."""
    notices: str
    """The faults that it notices, and when."""
    silence: str = ""
    """The parameter that bounds how long it goes on without a message, if any."""
    assumed: tuple[str, ...] = ()
    """Assumptions about the robot and its sensors."""
    fails: tuple[str, ...] = ()
    """How it can fail without a notice."""
    unit: tuple[str, ...] = ()
    """Tests of the text in the engine."""


EVIDENCE: Mapping[str, Evidence] = {
    "deadman": Evidence(
        ("IEC 60204-1:2016, 9.2.4, cableless control that loses its communication",),
        "a node that commanded a motion sends nothing for `silent`",
        "silent",
        (
            "the base executes the last command until the next",
            "a cut link delivers what it held within `resume`",
        ),
        ("a node that repeats its last motion for ever looks alive",),
        unit=(
            "test_a_deadman_stops_for_each_node_that_falls_silent",
            "test_a_deadman_stops_within_its_time_and_a_tick",
        ),
    ),
    "speed": Evidence(
        ("ISO 3691-4:2020, 4.3, speed control",),
        "a command beyond the limits, in that command",
        assumed=("the base drives at the velocity that it is commanded",),
        fails=("a base that drives faster than its command",),
        unit=("test_a_guard_does_what_its_page_says",),
    ),
    "separation": Evidence(
        (
            "ISO 3691-4:2020, 4.8.2, detection of persons",
            "ISO 10218-2:2025, clause not known, speed and separation monitoring (before: ISO/TS 15066:2016, 5.5.4)",
            "ISO 13855:2010, 6.3, approach parallel to the zone: S = 1.6 m/s T + C, with C of 0.85 m at least, which is"
            " more than `margin` by default",
            "IEC 61496-3:2018, clause not known, scanners",
        ),
        "a nearer thing in the next scan; a scanner that is silent for `silent`",
        "silent",
        (
            "the base brakes at `braking` after `reaction`, which includes the delay of scanner and network",
            "the scanner sees what is to be protected, and every direction of the motion",
            "a person walks at most at `person`, and does not step from beside the way into the stopping distance",
        ),
        ("a scan that is frozen", "glass, and things above or below the plane of the scanner"),
        unit=(
            "test_a_scan_that_is_too_large_to_judge_stops_the_base",
            "test_a_faulty_sensor_never_releases_the_base",
        ),
    ),
    "fence": Evidence(
        ("no standard: a limit of the workspace by the robot's own position",),
        "the edge in the next position; a position that is silent for `silent`",
        "silent",
        (
            "the base stands still `ahead` after a command, which includes the delay of the position",
            "the position is in the frame of the polygon, and wrong by less than half of `margin`",
        ),
        ("a position that drifts, jumps or is frozen", "a heading that is wrong"),
        unit=("test_a_base_stays_inside_a_fence", "test_a_base_outside_a_fence_only_comes_back"),
    ),
    "sensor": Evidence(
        ("IEC 61496-3:2018, clause not known, detection of faults",),
        "a sensor that is silent for `silent`, repeats its values `frozen` times, or has too few valid values",
        "silent",
        ("a working sensor never repeats all its values",),
        ("wrong values that change", "measurements that come late, at their usual rate"),
        unit=(
            "test_a_guard_does_what_its_page_says",
            "test_a_moving_base_is_stopped_when_its_sensor_falls_silent",
        ),
    ),
    "estop": Evidence(
        (
            "ISO 3691-4:2020, 4.1.14, no automatic restart",
            "IEC 60204-1:2016, 9.2.2, stop category 2 at best, since the drives keep their power; so it is **not an"
            " emergency stop in the sense of ISO 13850:2015, 4.1**, which has category 0 or 1",
            "ISO 13849-1:2015, 5.2.2, manual reset; two nodes that reset are no two-hand control",
        ),
        "a press, in that message; a button that is silent for `silent`",
        "silent",
        ("each button is a node that sends its state at least every `silent`",),
        ("the button's computer or cable, before `silent`", "a base that ignores a zero velocity"),
        unit=(
            "test_a_guard_does_what_its_page_says",
            "test_after_a_reset_each_node_stands_before_it_moves",
        ),
    ),
    "arm": Evidence(
        ("no standard: an interlock of preconditions",),
        "a condition that is missing or older than `silent` (the check: `checked`)",
        "silent",
        ("the charge, the fix and the check are measured",),
        ("a battery that reports a wrong charge",),
        unit=("test_a_guard_does_what_its_page_says",),
    ),
    "answer": Evidence(
        ("no standard: a deadline of a goal",),
        "a goal without a result after its deadline",
        assumed=("the action's server stops when its goal is cancelled",),
        fails=("a server that ignores the cancel",),
        unit=("test_a_goal_without_a_result_is_cancelled",),
    ),
    "joints": Evidence(
        ("ISO 10218-1:2011, 5.12.3, soft limits of axes",),
        "a point beyond a limit, before the trajectory begins",
        assumed=(
            "the controller follows the trajectory from now on: straight to the first point, then along the splines"
            " of joint_trajectory_controller",
        ),
        fails=(
            "a path within all limits that meets something; a curve to the first point; a stamp in the past",
        ),
        unit=(
            "test_a_trajectory_keeps_the_limits_of_its_joints",
            "test_the_curve_of_a_controller_keeps_the_limits_of_joints",
            "test_samples_of_a_motion_that_ends_at_a_limit_pass",
            "test_a_trajectory_needs_the_present_position_of_each_joint",
            "test_a_stream_of_points_keeps_the_velocity_of_one_trajectory",
        ),
    ),
    "rate": Evidence(
        ("no standard: a bound of the number of commands",),
        "a command beyond the rate, in that command",
        fails=("a fast motion: only the number is bounded",),
        unit=("test_a_guard_does_what_its_page_says",),
    ),
    "agree": Evidence(
        ("ISO 13849-1:2015, table E.1, cross monitoring of two channels",),
        "`samples` measurements in a row that differ; a source that is silent for `silent`",
        "silent",
        ("the two sources have no common cause of an error",),
        ("both are wrong alike, as when one is calculated from the other",),
        unit=("test_a_guard_does_what_its_page_says",),
    ),
    "sane": Evidence(
        ("no standard: finite numbers",),
        "a number that is infinite or NaN, in that command",
        fails=("a finite velocity that is too high",),
        unit=("test_a_guard_does_what_its_page_says",),
    ),
    "enable": Evidence(
        (
            "ISO 3691-4:2020, 4.9, presence of the operator",
            "ISO 10218-1:2011, 5.8.3, enabling device, which has three positions",
        ),
        "a device that is let go, in that message; one that is silent for `silent`",
        "silent",
        (
            "each device is a node that sends its state at least every `silent`",
            "a device in panic sends `false`",
        ),
        ("a switch that is tied down after it was let go once", "a base that ignores a zero velocity"),
        unit=("test_a_device_that_is_let_go_stops_the_base_at_once", "test_pressing_again_starts_nothing"),
    ),
    "mode": Evidence(
        (
            "ISO 3691-4:2020, 4.9, modes of operation",
            "ISO 10218-1:2011, 5.7.3, manual mode: its 0.25 m/s are those of a tool centre point with an enabling"
            " device, and not of a base",
        ),
        "manual mode, in that message; a node that is silent for `silent`",
        "silent",
        ("the base drives at the velocity that it is commanded",),
        ("a person who works in automatic mode",),
        unit=("test_the_mode_is_manual_until_all_say_automatic",),
    ),
    "overspeed": Evidence(
        ("IEC 61800-5-2:2016, clause not known, safely-limited speed, by a measurement",),
        "a measured velocity beyond the limit, in that message; one that is silent for `silent`",
        "silent",
        ("the velocity is measured, and not copied from the command",),
        (
            "wheels that slip",
            "a measurement that is frozen, or comes late",
            "a base that ignores a zero velocity",
        ),
        unit=("test_a_base_that_is_measured_too_fast_stops_until_it_stands_and_zero_is_commanded",),
    ),
    "standstill": Evidence(
        ("IEC 61800-5-2:2016, clause not known, safe operating stop, by a measurement",),
        "a measured motion `settle` after the command to stand; a measurement that is silent for `silent`",
        "settle",
        ("the velocity is measured, and not copied from the command",),
        (
            "a measurement that is frozen, or comes late",
            "a base that ignores a zero velocity: a guard has no brake",
        ),
        unit=("test_a_base_that_moves_without_a_command_is_stopped_again_and_again",),
    ),
    "zone": Evidence(
        (
            "ISO 3691-4:2020, 4.8.2, detection of persons",
            "ISO 13855:2010, 6.3, approach parallel to the zone",
            "IEC 61496-3:2018, clause not known, scanners",
        ),
        "`points` rays that end in the zone or before it, within 20 ms of it; a scanner that is silent for `silent`",
        "silent",
        (
            "the zone covers the way of the base until it stands, and of a person who approaches",
            "the scanner sees what is to be protected, and every direction of the zone",
        ),
        (
            "a scan that is frozen",
            "glass, and things above or below the plane of the scanner",
            "a zone that is muted",
        ),
        unit=(
            "test_a_thing_in_the_zone_stops_the_base_until_it_is_clear_and_zero_is_commanded",
            "test_a_scan_that_does_not_see_the_zone_stops",
            "test_a_zone_that_a_thing_before_it_hides_is_not_free",
        ),
    ),
    "diagnostics": Evidence(
        ("no standard: the robot's own diagnostics",),
        "a named entry at ERROR or STALE, in that message; one that is silent for `silent`",
        "silent",
        (
            "the node of each entry notices its fault",
            "each entry comes at least every `silent`, also while it is well",
        ),
        ("a fault that the robot's nodes do not notice", "a base that ignores a zero velocity"),
        unit=(
            "test_an_entry_that_is_bad_silent_or_missing_stops_the_base_until_a_zero",
            "test_entries_have_a_name_a_beginning_or_a_hardware_id",
        ),
    ),
    "withhold": Evidence(
        ("no standard: privacy",),
        "the switch, in that message; a switch that is silent for `silent`",
        "silent",
        ("all topics that show the same scene are withheld",),
        ("the same picture on another topic, by a service, or in a recording",),
        unit=("test_a_topic_is_withheld_until_all_switches_are_off_and_speak",),
    ),
}

_HEAD = """\
# Evidence about guards

Generated by `make pages`; do not edit.

**A guard is a protective measure beside the driver's own timeout and a hardware stop. It is not a safety function
with a performance level**: it runs on a computer and a network without a claimed reliability, and Linux gives no
guaranteed time. An assessor takes no credit for it in the calculation of a performance level or a safety integrity
level.

- **Followed, not claimed**: edition and clause of each standard whose subject a preset follows in part; for vehicles,
  ISO 3691-4 comes first. All are *unchecked*: the authors of this page had no access to the texts of ISO and IEC
  standards. The numbers come from public tables of contents and articles, or from memory. Later editions, such as
  ISO 3691-4:2023, ISO 13849-1:2023, ISO 13855:2024 and ISO 10218:2025, may have others. The equation of speed and
  separation monitoring is discussed in a [public article of NIST](https://pmc.ncbi.nlm.nih.gov/articles/PMC5117641).
- **Proved** means that for every message of up to 512 KiB and every state the compiled code of the event does what its
  text says ([the proofs](../../dev/assurance.md#the-code-of-an-event)). Whether the text keeps the promise is not
  proved. Timers (`tick`) are outside of the proofs, and the `tick` of a `deadman` is the guard: it is tested and
  simulated.
- **Simulated** means random [worlds](../../dev/assurance.md#guards-in-simulated-worlds) with a robot, its sensors,
  persons and operators, within the assumptions that are listed for each preset. Timers are due on time there: the delay
  of a relay is measured (below), not simulated. In a part of the worlds an **act** happens to the guard: it is disabled
  and enabled in motion (*switch*), held and resumed (*hold*), gets bytes that are not a message (*cut*), or its process
  is replaced, with its state (*restart*) or without (*lost*). A base that drove while its guard was disabled is judged
  from its next standstill on, if no stop could have prevented the harm. Where none of n worlds broke a law, at most 3/n
  of all such worlds do, with 95 % confidence.
- **Pairs** are worlds with two guards of different presets on one topic: {pairs}.
- **Tested in the engine** names tests of the preset's text. With real nodes, the stops of the engine are tested by a
  guard that is written for the test, not by each preset: `test_a_restart_sends_stops_until_a_command_comes`,
  `test_the_base_gets_stops_and_nothing_else`.
- **Digest**: the first 16 hexadecimal digits of the SHA-256 of the preset's text that this page describes.

## The time to stop

From the cause to the stop at the base. The guard's part follows from its text, with the values by default. The relay's
part has no guaranteed bound: of 1,000 stops on a busy machine the slowest took {relay} ms
([measured](../monitors.md#how-fast-a-guard-stops)). Add the base's own reaction and the time in which it brakes from
its speed, and choose the values so that the sum is safe.

The sum is for a silent source (`standstill`: for `settle`). A thing that a message shows is noticed in that message:
then the interval of the messages takes the place of the silence, `frozen` (`sensor`) or `samples` (`agree`) times. The
check of `arm` has `checked` instead of `silent`, and the goal of `answer` its deadline before the sum.

| preset | it notices | silence | timer | relay, at most measured | sum |
|---|---|---|---|---|---|
"""

_COMMON = (
    ("the appliance's machine, its power or its network dies", "no message comes, and no stop",
     "the driver's timeout: [measure it](../../guards.md#does-the-driver-stop-the-base)"),
    ("guard and controller on one computer, which hangs or is overloaded", "commands and stops are late together",
     "the driver's timeout, on another processor"),
    ("one sensor is the source of navigation and of the guard", "both believe the same wrong measurement",
     "a second source (`agree`), the bumper, the hardware stop"),
    ("one clock for all timers of a relay", "all timers are late together", "the driver's timeout"),
    ("a node commands the base's driver directly, or by another topic", "the guard does not see the command",
     "a network on which only the appliance reaches the base"),
    ("a wrong value, topic or frame", "the guard works as configured",
     "a test drive: shadow mode, then `--confirm-within`"),
)  # fmt: skip
"""Causes that make several guards fail together, their effects, and what remains."""


def page() -> str:
    """Return the page. Raises `BuildError` if a preset has no row here or no row of proofs."""
    for rows, where in (
        (EVIDENCE, "EVIDENCE of lab/guards_evidence_page.py"),
        (_proofs(), str(ASSURANCE)),
    ):
        if missing := PRESETS.keys() - rows.keys():
            raise BuildError(f"add {', '.join(sorted(missing))} to {where}")
    return "\n".join(
        (
            _HEAD.format(relay=RELAY_MS, pairs=_simulated(PAIRS, _results())) + "".join(_times()),
            *_presets(),
            *_common(),
        )
    )


def _common() -> Iterator[str]:
    yield "## Common causes\n\nThese make several guards fail together. The robot's own stop must not share them.\n"
    yield "| cause | effect | what remains |\n|---|---|---|"
    for row in _COMMON:
        yield f"| {' | '.join(row)} |"
    yield ""


def _default(preset: Preset, name: str) -> float | None:
    """Return the milliseconds of a parameter by default."""
    found = {one.name: one for one in preset.parameters}.get(name)
    return None if found is None else float(found.default) * 1000


def _times() -> Iterator[str]:
    for name, preset in PRESETS.items():
        row = EVIDENCE[name]
        found = _TICK.search(preset.text)
        tick = int(found[1]) if found and row.silence else 0
        silence = _default(preset, row.silence) if row.silence else None
        total = (silence or 0) + tick + RELAY_MS
        off = row.silence and not silence
        summed = "never by silence: it is off by default" if off else f"{total:.0f} ms"
        parts = (f"`{row.silence}`, {silence:.0f} ms" if silence else "-", f"{tick} ms" if tick else "-")
        yield f"| `{name}` | {row.notices} | {parts[0]} | {parts[1]} | {RELAY_MS} ms | {summed} |\n"


def _presets() -> Iterator[str]:
    proofs, results = _proofs(), _results()
    for name, preset in PRESETS.items():
        row = EVIDENCE[name]
        yield f"## {name}\n\n{preset.what}\n"
        yield "| | |\n|---|---|"
        yield f"| version, digest | {preset.version}, `{text_digest(preset.text)}` |"
        yield f"| followed, not claimed | {'; '.join(row.clauses)} |"
        values = ", ".join(f"`{one.name}` = {one.default} {one.unit}".strip() for one in preset.parameters)
        yield f"| values by default | {values or 'none'} |"
        yield f"| assumed | {'; '.join(row.assumed) or 'nothing beyond the common causes'} |"
        proved, open_ = proofs[name]
        yield f"| proved | {proved or 'nothing'} |"
        ticks = "`tick` and all other timers" if _TICK.search(preset.text) else "timers, of which it has none"
        yield f"| not proved | {f'{open_}; ' if open_ else ''}{ticks} |"
        yield f"| simulated | {_simulated(name, results)} |"
        if left := _left_out(name):
            yield f"| left out of the worlds | {left} |"
        if name in results and (acts := _acts(name, results[name])):
            yield f"| worlds by act | {acts} |"
        yield f"| tested in the engine | {_named(row.unit)} |"
        yield f"| fails without a notice | {'; '.join(row.fails)} |\n"


def _named(tests: tuple[str, ...]) -> str:
    return " ".join(f"`{one}`" for one in tests)


def _proofs() -> dict[str, tuple[str, str]]:
    table = (
        ASSURANCE.read_text(encoding="utf-8")
        .partition("| preset | proved | not proved |")[2]
        .partition("\n\n")[0]
    )
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]
    return {name.strip("`"): (proved, open_) for name, proved, open_ in rows}


def _results() -> Rows:
    return parsed(json.loads(RESULTS.read_text(encoding="utf-8"))) if RESULTS.exists() else {}


def _left_out(name: str) -> str:
    """Return the events that no world has, because the preset breaks a law at them."""
    by_reason: dict[str, list[str]] = {}
    for event, why in WORLDS[name].left_out().items() if name in WORLDS else ():
        by_reason.setdefault(why, []).append(f"*{event}*")
    return "; ".join(f"{', '.join(events)}: {why}" for why, events in by_reason.items())


def _simulated(name: str, results: Rows) -> str:
    if name in NOT_MODELLED:
        return f"no: {NOT_MODELLED[name]}"
    row = results.get(name)
    if row is None:
        return "no long run yet"
    if row.digest != present_digests()[name]:
        return f"not since its text changed ({row.date})"
    return run_line(row)


def _acts(name: str, row: Row) -> str:
    """Return in how many worlds each act happened, as far as it was counted."""
    counted = sum(row.acts.values())
    parts = ", ".join(f"*{act}* {row.acts.get(act, 0):,}" for act in WORLDS[name].acts())
    return f"{parts} (of {counted:,} worlds in which it was counted)" if counted else ""


def run_line(row: Row) -> str:
    """Return a row of the results in one line, with the worlds of each commit."""
    near = "" if row.closest is None else f", closest {row.closest * 100:.1f} cm"
    broken = sum(row.violations.values())
    laws = f"{broken} broke a law" if broken else f"none broke a law ({at_most(row.worlds)})"
    if sent := row.honest.get("sent", 0):
        laws += f", {row.honest['passed']:,} of {sent:,} honest commands passed"
    counts = f"commit `{next(iter(row.commits))}`"
    if len(row.commits) > 1:
        counts = ", ".join(f"{worlds:,} of commit `{one}`" for one, worlds in row.commits.items())
    return f"{row.worlds:,} worlds from seed {row.first_seed}, {row.seconds:,} s, {laws}{near} ({row.date}, {counts})"
