"""The facts about each preset beyond its text, and the digest that binds a guard to its preset, text and values.

The evidence page and the safety manual of a robot are made from the same rows.

The same digest in `rosrv guard list --json` at two times means the same guard. The digest of a preset's text is also on
the evidence page, beside what was proved and simulated of this text.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from appliance.features.guards.presets import Preset
from rosmop.form.switch_words import without_file_switch

_DIGITS = 16


def text_digest(text: str) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of a text, such as a preset as it is shipped."""
    return hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]


def guard_digest(preset: Preset, text: str, values: Mapping[str, str]) -> str:
    """Return the digest of a guard with this text, made from the preset, and with these values in force."""
    plain = without_file_switch(text)  # on or off, it is the same guard
    bound = json.dumps([preset.name, text_digest(preset.text), plain, sorted(values.items())])
    return text_digest(bound)


NO_SAFETY_FUNCTION = """\
**A guard is a protective measure beside the driver's own timeout and a hardware stop. It is not a safety function
with a performance level**: it runs on a computer and a network without a claimed reliability, and Linux gives no
guaranteed time. An assessor takes no credit for it in the calculation of a performance level or a safety integrity
level."""

MEANING_OF_SUMS = """\
The sum is for a silent source (`standstill`: for `settle`). A thing that a message shows is noticed in that message:
then the interval of the messages takes the place of the silence, `frozen` (`sensor`) or `samples` (`agree`) times. The
check of `ready` has `checked` instead of `silent`, and the goal of `answer` its deadline before the sum."""

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
        unit=("test_a_guard_does_what_its_page_says",),
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
            "test_a_guard_does_what_its_page_says",
            "test_a_scan_that_is_too_large_to_judge_stops_the_base",
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
        unit=(
            "test_a_guard_does_what_its_page_says",
            "test_a_fast_base_does_not_drive_across_a_thin_part_outside",
        ),
    ),
    "sensor": Evidence(
        ("IEC 61496-3:2018, clause not known, detection of faults",),
        "a sensor that is silent for `silent`, repeats its values `frozen` times, or has too few valid values",
        "silent",
        ("a working sensor never repeats all its values",),
        ("wrong values that change", "measurements that come late, at their usual rate"),
        unit=("test_a_guard_does_what_its_page_says",),
    ),
    "estop": Evidence(
        (
            "ISO 3691-4:2020, 4.1.14, no automatic restart",
            "IEC 60204-1:2016, 9.2.2, stop category 2 at best, since the drives keep their power; so it is **not an"
            " emergency stop in the sense of ISO 13850:2015, 4.1**, which has category 0 or 1",
            "ISO 13849-1:2015, 5.2.2, manual reset; two nodes that reset are not a two-hand control",
        ),
        "a press, in that message; a button that is silent for `silent`",
        "silent",
        ("each button is a node that sends its state at least every `silent`",),
        ("the button's computer or cable, before `silent`", "a base that ignores a zero velocity"),
        unit=("test_a_guard_does_what_its_page_says",),
    ),
    "ready": Evidence(
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
            "the controller is joint_trajectory_controller, has trajectories in 10 ms, and gets none past the guard",
            "the clocks agree, or the stamps are of a simulated clock and `simulated` is set",
        ),
        fails=("a path within all limits that meets something",),
        unit=(
            "test_a_trajectory_keeps_the_limits_of_its_joints",
            "test_the_curve_of_a_controller_keeps_the_limits_of_joints",
            "test_samples_of_a_motion_that_ends_at_a_limit_pass",
            "test_a_trajectory_needs_the_present_position_of_each_joint",
            "test_a_stream_of_points_keeps_the_velocity_of_one_trajectory",
            "test_a_trajectory_is_judged_as_its_controller_executes_it",
            "test_a_trajectory_waits_while_the_arm_is_reported_where_it_begins",
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
    "hold_to_run": Evidence(
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
        unit=("test_a_guard_does_what_its_page_says",),
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
        unit=("test_a_guard_does_what_its_page_says",),
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
        unit=("test_each_state_of_each_observed_field_keeps_the_laws",),
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
        unit=("test_each_state_of_each_observed_field_keeps_the_laws",),
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
            "test_each_state_of_each_observed_field_keeps_the_laws",
            "test_a_zone_that_a_thing_before_it_hides_is_not_free",
        ),
    ),
    "diagnostics": Evidence(
        ("no standard: the robot's own diagnostics",),
        "a named entry at ERROR or STALE, in that message; one that is silent for `silent`",
        "silent",
        (
            "the node of each entry notices its fault",
            "each entry comes at least every `silent`, even while it is well",
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


COMMON_CAUSES = (
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


class StoppingTime(NamedTuple):
    """The parts of the time from the end of a source's messages to the stop at the base, in milliseconds."""

    silence: float
    """The value that `Evidence.silence` names; 0 if there is none, or if it is off."""
    tick: int
    relay: float
    total: float | None
    """The sum, or None if the guard never stops by silence, because its value is 0."""


def tick_of(preset: Preset) -> int:
    """Return the period of the preset's tick in milliseconds, or 0 without one."""
    match = _TICK.search(preset.text)
    return int(match[1]) if match else 0


def stopping_time(preset: Preset, values: Mapping[str, str], relay: float) -> StoppingTime:
    """Return the time of a guard with these values, where the relay takes `relay` milliseconds."""
    row = EVIDENCE[preset.name]
    silence = float(values[row.silence]) * 1000 if row.silence else 0.0
    tick = tick_of(preset) if row.silence else 0
    off = bool(row.silence) and not silence
    return StoppingTime(silence, tick, relay, None if off else silence + tick + relay)
