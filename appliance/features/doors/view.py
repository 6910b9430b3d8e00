"""Show doors in the status, the alarms and the metrics."""

from collections.abc import Iterator, Mapping
from typing import Annotated

import msgspec

from appliance.base.counted import counted
from appliance.base.metric import Metric, counter, gauge
from appliance.channel.answers.field_docs import doc
from appliance.features.view import AlarmKind, FeatureView, Samples, StateView, Trouble

LATELY_SECONDS = 600.0
_MANY_RESTARTS = 3  # within `LATELY_SECONDS`
_FULL_SECONDS = 60.0
_MAX_NAMED = 5


class DoorHealth(msgspec.Struct, frozen=True, kw_only=True):
    """A door's counts since the start of its process; `restarts` counts its processes since the start of RVMaster."""

    name: Annotated[str, doc("`door:NAME` in the policy")]
    up: Annotated[bool, doc("whether it serves")]
    trouble: Annotated[str, doc("why it does not serve, or empty if it serves or starts")]
    connections: Annotated[int, doc("at present")]
    limit: Annotated[int, doc("the most connections, `doors.connections`")]
    full_seconds: Annotated[float, doc("how long it has been at its limit of connections, or 0 if it is not")]
    received: Annotated[int, doc("frames from clients")]
    sent: Annotated[int, doc("frames to clients")]
    received_bytes: Annotated[int, doc("bytes from clients, as on the wire")]
    sent_bytes: Annotated[int, doc("bytes to clients, as on the wire")]
    dropped: Annotated[int, doc("messages for clients that read too slowly")]
    refusals: Annotated[int, doc("requests of clients that were refused")]
    refused_connections: Annotated[int, doc("connections in excess of the limits")]
    restarts: Annotated[int, doc("unexpected ends of its process")]
    restarts_lately: Annotated[int, doc("the same in the last ten minutes")]


class DoorsState(msgspec.Struct, frozen=True):
    """The doors, each with its connections, counts and restarts."""

    doors: Annotated[list[DoorHealth], doc("the oldest first")]


_METRICS: Mapping[str, Metric] = {
    "up": gauge("rosrv_door_up", "1 while the door serves; absent without doors", "door"),
    "connections": gauge("rosrv_door_connections", "clients connected", "door"),
    "limit": gauge("rosrv_door_connections_limit", "the most clients at the same time (`doors.connections`)", "door"),
    "received": counter("rosrv_door_messages_received_total", "frames from clients", "door"),
    "sent": counter("rosrv_door_messages_sent_total", "frames to clients", "door"),
    "dropped": counter("rosrv_door_messages_dropped_total", "messages dropped for clients that are too slow", "door"),
    "received_bytes": counter("rosrv_door_bytes_received_total", "bytes from clients, as on the wire", "door"),
    "sent_bytes": counter("rosrv_door_bytes_sent_total", "bytes to clients, as on the wire", "door"),
    "refusals": counter("rosrv_door_refusals_total", "requests of clients that were refused", "door"),
    "refused_connections": counter(
        "rosrv_door_connections_refused_total", "connections in excess of the limits", "door"
    ),
    "restarts": counter("rosrv_door_restarts_total", "unexpected ends of the process of the door", "door"),
}  # fmt: skip
"""All counters except that of restarts begin at zero when the door's process starts."""


def _alarms(state: DoorsState) -> Iterator[Trouble]:
    down = [f"{door.name} ({door.trouble})" for door in state.doors if door.trouble]
    if down:
        yield Trouble("doors-down", f"doors do not serve: {_listed(down)}; see rosrv door list")
    dying = [
        f"{door.name} ({counted(door.restarts_lately, 'time')})"
        for door in state.doors
        if door.restarts_lately >= _MANY_RESTARTS
    ]
    if dying:
        text = f"processes of doors keep ending, in the last ten minutes of {_listed(dying)}"
        yield Trouble("doors-restarting", f"{text}; see rosrv audit search --event 'door failed' --since 10m")
    full = [
        f"{door.name} ({door.connections} of {door.limit})"
        for door in state.doors
        if door.full_seconds >= _FULL_SECONDS
    ]
    if full:
        text = f"doors have been at their limit of connections for a minute: {_listed(full)}"
        yield Trouble(
            "doors-full",
            f"{text}; rosrv door list shows who is connected, doors.connections is the limit",
        )


def _listed(names: list[str]) -> str:
    more = len(names) - _MAX_NAMED
    return ", ".join(names[:_MAX_NAMED]) + (f" and {more} more" if more > 0 else "")


def _samples(state: DoorsState) -> dict[str, Samples]:
    doors = [msgspec.structs.asdict(door) for door in state.doors]
    return {
        metric.name: [((door["name"],), door[field]) for door in doors] for field, metric in _METRICS.items()
    }


def _line(state: DoorsState) -> tuple[str, str]:
    connected = sum(door.connections for door in state.doors)
    down = [door.name for door in state.doors if door.trouble]
    words = [
        f"{len(state.doors)} {'door' if len(state.doors) == 1 else 'doors'}",
        f"{connected} {'connection' if connected == 1 else 'connections'}",
        *([f"{_listed(down)} not serving"] if down else []),
    ]
    return "doors", ", ".join(words)


DOORS_VIEW = FeatureView(
    (
        StateView(
            "doors",
            DoorsState,
            "the doors, or null if there are none",
            before="handled_alarms",
            kinds={
                "doors-down": AlarmKind("warning", "correct why the door does not serve"),
                "doors-restarting": AlarmKind("warning", "read why its process ends"),
                "doors-full": AlarmKind("warning", "see who is connected, or raise the limit"),
            },
            alarms=_alarms,
            metrics=tuple(_METRICS.values()),
            samples=_samples,
            line=_line,
        ),
    ),
)
