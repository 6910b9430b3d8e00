"""Show in the status which guards limit or stop the robot now."""

import datetime
from collections.abc import Iterator
from typing import Annotated

import msgspec

from appliance.base import clock
from appliance.channel.answers.field_docs import Moment, doc
from appliance.features.view import AlarmKind, FeatureView, Pieces, StateView, Trouble

_BEGINS_SECONDS = 10.0


class ActingGuard(msgspec.Struct, frozen=True):
    """A guard that limits or stops the robot now."""

    name: Annotated[str, doc("the guard")]
    since: Annotated[Moment, doc("it has done so since then, without a pause of 2 seconds")]


class BypassedGuard(msgspec.Struct, frozen=True):
    """A node that takes a guarded command from publishers that the appliance did not give it."""

    topic: Annotated[str, doc("the guarded topic")]
    node: Annotated[str, doc("the node that takes commands past the guard")]
    host: Annotated[str, doc("its host")]
    publishers: Annotated[list[str], doc("the URIs of the publishers, as the node names them")]


class OlderGuard(msgspec.Struct, frozen=True):
    """A guard in force with the text of an older version of its preset."""

    name: Annotated[str, doc("the guard")]
    preset: Annotated[str, doc("its preset")]
    version: Annotated[int, doc("the version in its text")]
    present: Annotated[int, doc("the present version of the preset")]
    edited: Annotated[bool, doc("its text was also changed, so `rosrv guard upgrade` does not replace it")]


class GuardsState(msgspec.Struct, frozen=True):
    """The loaded guards."""

    loaded: Annotated[int, doc("all guards, also disabled ones and those in shadow mode")]
    acting: Annotated[list[ActingGuard], doc("the guards that limit or stop the robot now")]
    elsewhere: Annotated[
        list[str], doc("guarded topics whose base is on another machine than the appliance, as sentences")
    ] = []
    bypassed: Annotated[
        list[BypassedGuard],
        doc("nodes that take a guarded command past the appliance; asked every few seconds"),
    ] = []
    unanswered: Annotated[
        list[str], doc("nodes with a guarded command that do not say from whom they take it")
    ] = []
    never_enabled: Annotated[
        dict[str, str],
        doc(
            "guards that neither an operator nor their file switched, with their state by the setting `enable`:"
            " `off` or `shadow`"
        ),
    ] = {}
    older: Annotated[list[OlderGuard], doc("guards in force with an older version of their preset")] = []
    former: Annotated[
        dict[str, str], doc("monitors that were guards before 0.4, by name, with what to do about each")
    ] = {}


def _since(guard: ActingGuard) -> str:
    began = datetime.datetime.fromtimestamp(guard.since, datetime.UTC)
    return f"{guard.name} has limited or stopped the robot since {began:%Y-%m-%d %H:%M:%SZ}"


def _alarms(state: GuardsState) -> Iterator[Trouble]:
    for guard in state.acting:
        text = f"the guard {_since(guard)}: rosrv audit search --category monitor --text {guard.name}"
        yield Trouble(f"guard-acts:{guard.name}", text)
    for name, idle in state.never_enabled.items():
        why = "because neither an operator nor its file brought it into force"
        text = (
            f"the guard {name} is disabled, {why}: rosrv monitor enable {name}"
            if idle == "off"
            else f"the guard {name} only records (shadow mode), {why}: rosrv monitor enforce {name}"
        )
        yield Trouble(f"guard-off:{name}", text, "monitors")
    for old in state.older:
        remedy = (
            f"its text was also edited, so compare it with the preset, then remove it and make it again: rosrv guard"
            f" remove {old.name}"
            if old.edited
            else f"rosrv guard upgrade {old.name} --when-standing"
        )
        text = f"the guard {old.name} has {old.preset} {old.version}; the present version is {old.present}: {remedy}"
        yield Trouble(f"guard-older:{old.name}", text, "monitors")
    for name, text in state.former.items():
        yield Trouble(f"guard-older:{name}", text, "monitors")
    for one in state.bypassed:
        text = (
            f"{one.node} takes {one.topic} from {', '.join(one.publishers)}, past its guards: end that process, and"
            f" run rosrv protect --strict on {one.host}"
        )
        yield Trouble(f"guard-bypassed:{one.topic}", text)
    for sentence in state.elsewhere:
        text = f"{sentence}: measure whether the driver then stops it, with rosrv guard check-driver TOPIC --by TOPIC"
        yield Trouble(f"guard-elsewhere:{sentence.partition(':')[0]}", text)
    for node in state.unanswered:
        text = f"{node} does not answer getBusInfo: whether it takes commands past its guards is unknown"
        yield Trouble(f"guard-unanswered:{node}", text)


def _line(state: GuardsState) -> tuple[str, Pieces]:
    """Return the guards; a stop is red in its first seconds only: later it holds a robot that stands."""
    now = clock.wall()
    acting = [
        (f"; {_since(guard)}", "bold red" if 0 <= now - guard.since < _BEGINS_SECONDS else "")
        for guard in state.acting
    ]
    return "guards", [(f"{state.loaded} loaded", ""), *acting]


GUARDS_VIEW = FeatureView(
    "guards",
    (
        StateView(
            "guards",
            GuardsState,
            "the guards, or null if none is loaded",
            kinds={
                "guard-acts": AlarmKind("notice", "it does its work: a parked robot may be held for days"),
                "guard-off": AlarmKind("warning", "bring it into force, or remove it"),
                "guard-older": AlarmKind("warning", "upgrade it when the robot stands"),
                "guard-bypassed": AlarmKind("alarm", "end the process that commands past the guard"),
                "guard-elsewhere": AlarmKind("warning", "measure whether the driver stops the base"),
                "guard-unanswered": AlarmKind("notice", "its node does not answer now"),
            },
            alarms=_alarms,
            line=_line,
        ),
    ),
)
