"""Show in the status which guards limit or stop the robot now."""

import datetime
from collections.abc import Iterator, Mapping
from typing import Annotated

import msgspec

from appliance.base import clock
from appliance.base.metric import counter, gauge
from appliance.channel.answers.field_docs import Moment, doc
from appliance.features.guards.guard_answers import GuardTimes
from appliance.features.view import AlarmKind, FeatureView, Pieces, Samples, StateView, Trouble

_BEGINS_SECONDS = 10.0


class ActingGuard(msgspec.Struct, frozen=True):
    """A guard that limits or stops the robot now."""

    name: Annotated[str, doc("the guard")]
    since: Annotated[Moment, doc("it has done so since then, without a pause of 2 seconds")]
    cause: Annotated[str, doc("why it stops the robot now, or empty while it only limits it")] = ""


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
    late: Annotated[
        dict[str, str], doc("guards that acted too late in the last minute, each as a sentence")
    ] = {}
    times: Annotated[dict[str, GuardTimes], doc("how late each guard has acted, over restarts")] = {}
    heartbeat: Annotated[
        str | None, doc("why the heartbeat is off, an empty text while it is on, or null if none is set")
    ] = None


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
    for name, sentence in state.late.items():
        yield Trouble(f"guard-late:{name}", f"the guard {name} {sentence}: rosrv guard list", "monitors")
    if state.heartbeat:
        yield Trouble("heartbeat-off", f"the heartbeat is off: {state.heartbeat}", "monitors")
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
        (
            f"; {_since(guard)}{guard.cause and f': {guard.cause}'}",
            "bold red" if 0 <= now - guard.since < _BEGINS_SECONDS else "",
        )
        for guard in state.acting
    ]
    return "guards", [(f"{state.loaded} loaded", ""), *acting]


_METRICS = (
    counter(
        "rosrv_guard_timed_total",
        "ticks and messages of a guard whose delay was measured, over restarts",
        "guard",
    ),
    counter(
        "rosrv_guard_late_total", "those of them that came later than `relay.late`, over restarts", "guard"
    ),
    gauge(
        "rosrv_heartbeat",
        "1 while the heartbeat of the guards is on, 0 while it is off; absent if none is set",
    ),
)


def _samples(state: GuardsState) -> Mapping[str, Samples]:
    times = state.times.items()
    found: dict[str, Samples] = {
        "rosrv_guard_timed_total": [((name,), one.timed) for name, one in times],
        "rosrv_guard_late_total": [((name,), one.late) for name, one in times],
    }
    return (
        found if state.heartbeat is None else {**found, "rosrv_heartbeat": [((), int(not state.heartbeat))]}
    )


GUARDS_VIEW = FeatureView(
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
                "guard-late": AlarmKind(
                    "warning", "find what keeps the relay or the machine busy; it ends after a minute"
                ),
                "heartbeat-off": AlarmKind(
                    "alarm", "bring the guard that it names into force: the drive gets no enable"
                ),
            },
            alarms=_alarms,
            metrics=_METRICS,
            samples=_samples,
            line=_line,
        ),
    ),
)
