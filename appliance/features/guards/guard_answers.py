"""The answers of control about guards."""

from typing import Annotated

import msgspec

from appliance.channel.answers.field_docs import Moment, doc
from appliance.channel.answers.monitor_answers import GivenState, Tag


class PresetParameter(msgspec.Struct, frozen=True):
    """A parameter of a preset. `least` and `most` are empty for values that are not numbers."""

    name: str
    kind: Annotated[str, doc("`int`, `double`, `bool`, `corners`, `joints` or `time`")]
    default: str
    unit: str
    least: str
    most: str
    what: Annotated[str, doc("its meaning, for a person")]
    loads: Annotated[bool, doc("it is in the text: a change loads the guard again, and for admins only")]


class PresetRow(msgspec.Struct, frozen=True):
    """A preset: its topics with their defaults, and the message types of each topic that has several."""

    preset: str
    version: int
    what: Annotated[str, doc("its effect, for a person")]
    topics: dict[str, str]
    types: dict[str, list[str]]
    parameters: list[PresetParameter]


class GuardRow(msgspec.Struct, frozen=True):
    """A loaded guard."""

    name: str
    preset: str
    file: str
    state: Annotated[
        str,
        doc(
            "`free`: it changed nothing in the last 2 seconds; `stopping`: it did; `holding`: it cannot judge, and"
            " waits for an operator; `shadow`: it only records; `off`: it is disabled"
        ),
    ]
    topics: Annotated[dict[str, str], doc("the topics that are given to it, by name")]
    types: Annotated[dict[str, str], doc("their message types, where the preset has several")]
    given: Annotated[list[GivenState], doc("constants and topics that are given to it")]
    loads: Annotated[dict[str, str], doc("values in its text: a polygon, limits of joints, a deadline")]
    stops: Annotated[int, doc("messages that it changed or dropped; in shadow mode: that it would have")]
    why_held: Annotated[str, doc("why it holds its topics, if it does")] = ""
    confirm_by: Annotated[
        Moment | None, doc("when it returns to shadow mode unless confirmed; null: it stays")
    ] = None
    off_until: Annotated[Moment | None, doc("when it is enabled again automatically; null: no end")] = None


class Guards(msgspec.Struct, frozen=True):
    """The presets, and the guards that are loaded, in the order in which they see messages."""

    revision: int
    tag: Tag
    presets: list[PresetRow]
    guards: list[GuardRow]


class Suggestion(msgspec.Struct, frozen=True):
    """A guard that fits the graph. `measured` are values from present rates; check all others."""

    preset: str
    name: str
    what: str
    topics: dict[str, str]
    measured: dict[str, str]
    values: dict[str, str]
    command: Annotated[str, doc("the command line that makes it")]


class Suggestions(msgspec.Struct, frozen=True):
    """Guards for each topic that commands a base or an arm, in the order in which they act."""

    suggestions: list[Suggestion]
