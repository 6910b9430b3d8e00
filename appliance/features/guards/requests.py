"""The requests of operators' tools about guards.

A guard is a monitor, so all other requests are those of monitors.
"""

from typing import Annotated

import msgspec

from appliance.channel.admin import MONITORS, AdminRequest, Confirm, Hold, OneMonitor, WaitingRequest
from appliance.channel.answers.field_docs import doc
from appliance.channel.answers.monitor_answers import Replacement
from appliance.channel.rest_operation import Body, parameter, rest
from appliance.features.guards.guard_answers import DriverCheck, GuardList, GuardPlan, ProofTest, Suggestions

_NO_GUARD = {404: "There is no such guard."}
_Text = Annotated[str, msgspec.Meta(max_length=4096)]
_Name = Annotated[str, msgspec.Meta(max_length=256)]
_Values = Annotated[dict[_Name, _Text], msgspec.Meta(max_length=50)]


@rest("viewer", "GET", "/v1/guards", ("presets",), name="guards")
class GuardsWanted(WaitingRequest[GuardList], frozen=True, tag="guards"):
    """The presets with their parameters, and the guards with their states."""

    presets: Annotated[bool, parameter("also the presets, which a client needs once")] = True


@rest("viewer", "GET", "/v1/guards/suggestions", name="guard_suggestions")
class GuardSuggestionsWanted(WaitingRequest[Suggestions], frozen=True, tag="guard suggestions"):
    """Guards that fit the topics of the running robot; nothing changes."""


@rest(
    "admin", "POST", "/v1/guards", ("confirm_within", "hold"), name="new_guard", of=MONITORS,
    body=Body("NewGuard", "A guard to make: its preset, its topics, and values of its parameters."),
)  # fmt: skip
class GuardNew(AdminRequest[Replacement], frozen=True, tag="guard new"):
    """Make a guard from a preset and load it; refused if a monitor has its name, or the topic has another type."""

    preset: Annotated[_Name, doc("the preset")]
    topics: Annotated[_Values, doc("by the names that the preset has for them; `command` is needed")]
    values: Annotated[_Values, doc("by parameter, as text")] = msgspec.field(default_factory=dict)
    types: Annotated[_Values, doc("types of topics that no node has yet, by the names of the topics")] = (
        msgspec.field(default_factory=dict)
    )
    name: Annotated[_Name, doc("its name; by default, that of the preset")] = ""
    shadow: Annotated[bool, doc("only record what it would have done")] = False
    expected: str | None = None
    confirm_within: Confirm = None
    hold: Hold = False


@rest(
    "admin", "PATCH", "/v1/guards/{name}", ("hold",), name="set_guard", of=MONITORS,
    body=Body("GuardValues", "New values of a guard's parameters, as text."),
    problems=_NO_GUARD,
)  # fmt: skip
class GuardSet(AdminRequest[GuardList], frozen=True, tag="guard set"):
    """Set parameters of a guard. It keeps its state, unless limits of joints or a deadline are set.

    Operators set constants with `PATCH /v1/monitors/{name}/given`.
    """

    name: OneMonitor
    values: Annotated[_Values, doc("by parameter")]
    expected: str | None = None
    hold: Hold = False


@rest(
    "admin", "POST", "/v1/guards/{name}/upgrade", ("confirm_within", "hold"), name="upgrade_guard",
    of=MONITORS, problems=_NO_GUARD,
    body=Body("GuardTopics", "Topics of a guard that is made again, instead of those that it has, or beside them."),
)  # fmt: skip
class GuardUpgrade(AdminRequest[Replacement], frozen=True, tag="guard upgrade"):
    """Make a guard of an older version again from the present preset, with its topics and values.

    Refused with the name of a value that the present version does not have, or does not allow. The guard begins again.
    """

    name: OneMonitor
    topics: Annotated[_Values, doc("by the names that the preset has for them")] = msgspec.field(
        default_factory=dict
    )
    expected: str | None = None
    confirm_within: Confirm = None
    hold: Hold = False


@rest(
    "operator", "POST", "/v1/guards/plan", ("hold",), name="plan_guard", problems=_NO_GUARD,
    body=Body(
        "GuardDraft",
        "A change of a guard to try: with `preset` a new guard, otherwise new values of the guard `name`.",
    ),
)  # fmt: skip
class GuardTry(WaitingRequest[GuardPlan], frozen=True, tag="guard try"):
    """Report what a new guard, new values, `enforce` or `upgrade` would load, change and hold; nothing changes."""

    preset: Annotated[_Name, doc("the preset of a new guard, or empty for a guard that is loaded")] = ""
    topics: Annotated[_Values, doc("of a new guard, or of an `upgrade` instead of those that it has")] = (
        msgspec.field(default_factory=dict)
    )
    types: Annotated[_Values, doc("of a new guard, as in a new guard")] = msgspec.field(default_factory=dict)
    name: Annotated[_Name, doc("the guard; by default, it has the name of the preset")] = ""
    values: Annotated[_Values, doc("by parameter, as text")] = msgspec.field(default_factory=dict)
    shadow: Annotated[bool, doc("a new guard only records what it would have done")] = False
    enforce: Annotated[bool, doc("bring the guard from shadow mode into force")] = False
    hold: Hold = False
    upgrade: Annotated[bool, doc("make the guard again from the present version of its preset")] = False


@rest("operator", "POST", "/v1/guards/{name}/test", name="test_guard", problems=_NO_GUARD, seconds=40.0)
class GuardTest(WaitingRequest[ProofTest], frozen=True, tag="guard test"):
    """Give a copy of a guard a fault, and send one stop to its driver, while the robot stands still.

    The guard in force, and its state, stay as they are, and no motion is sent. Rejected while a node drives, and if
    the robot is not known to stand still.
    """

    name: OneMonitor


@rest(
    "admin", "POST", "/v1/guards/driver-check", name="check_driver", seconds=40.0,
    body=Body(
        "NewDriverCheck",
        "A check of a robot's driver to begin; a person drives the base slowly while it lasts.",
    ),
)  # fmt: skip
class DriverCheckBegin(AdminRequest[DriverCheck], frozen=True, tag="driver check"):
    """Withhold the motions of a slowly driven base once, to measure how long its driver takes to stop the base.

    The appliance loads a monitor that acts once, and removes it afterwards. The client asks for the outcome
    at least every three seconds; otherwise the check ends.
    """

    command: Annotated[_Name, doc("the topic of the base's velocities")]
    by: Annotated[_Name, doc("the topic that shows how the base moves")]
    seconds: Annotated[float, doc("motions are withheld for at most this time", ge=0.2, le=10)] = 2.0
    patience: Annotated[float, doc("how long it waits for a slow drive, in seconds", ge=1, le=300)] = 30.0


@rest("viewer", "GET", "/v1/guards/driver-check", name="driver_check")
class DriverCheckWanted(WaitingRequest[DriverCheck], frozen=True, tag="driver check wanted"):
    """Return the driver's check; while it runs, wait up to a second for its end."""


REQUESTS = (
    GuardsWanted, GuardSuggestionsWanted, GuardNew, GuardSet, GuardUpgrade, GuardTry, GuardTest, DriverCheckBegin,
    DriverCheckWanted,
)  # fmt: skip
