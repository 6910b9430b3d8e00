"""The pairs of presets whose order on a topic changes what they promise.

The phases of the presets keep each row.
"""

from typing import NamedTuple


class Precedence(NamedTuple):
    """Each preset of `first` acts before each of `then`; `otherwise`: what happens in the other order."""

    first: tuple[str, ...]
    then: tuple[str, ...]
    otherwise: str


_STOPPING = (
    "agree",
    "deadman",
    "diagnostics",
    "estop",
    "fence",
    "hold_to_run",
    "mode",
    "overspeed",
    "ready",
    "sensor",
    "separation",
    "zone",
)
"""Presets that stop a base at once, whatever it does."""

PRECEDENCES = (
    Precedence(
        tuple(sorted((*_STOPPING, "standstill"))),
        ("speed",),
        "after a stop the base jumps to its full velocity, as if it had driven on",
    ),
    Precedence(
        tuple(sorted((*_STOPPING, "sane"))),
        ("standstill",),
        "a base that moves after a stop by the other guard is not noticed",
    ),
    Precedence(
        ("sane",),
        ("mode", "separation", "speed", "zone"),
        "of a command with an infinite velocity, the other velocities pass",
    ),
    Precedence(
        ("rate",),
        ("fence", "mode", "separation", "speed", "standstill", "zone"),
        "a dropped command counts as the motion in force, so the real one is not stopped or limited",
    ),
    Precedence(("deadman",), ("rate",), "dropped commands count as silence and stop the base"),
    Precedence(
        ("ready", "sane"),
        ("rate",),
        "a command that has to be stopped may be dropped, and the base drives on",
    ),
    Precedence(
        ("diagnostics", "estop", "hold_to_run", "joints", "ready", "sensor"),
        ("answer",),
        "a goal that was dropped is reported as late, and cancelled, after the deadline",
    ),
)
