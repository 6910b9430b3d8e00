"""Every bound of doors is in the table of the page, or has a reason why no user meets it."""

import ast
import re
from pathlib import Path

import pytest

import appliance.features.doors

FOLDER = Path(appliance.features.doors.__file__).parent
PAGE = Path("docs/reference/rosbridge.md")
_IS_BOUND = re.compile(r"MAX|LONGEST|LEAST|_SECONDS\b|_SECONDS$")

SHOWN = {
    "cbor_frames.MAX_NESTING": "70 levels",
    "cbor_frames.MAX_ITEMS": "50,000 in CBOR",
    "cbor_frames.MAX_NUMBERS": "500,000 numbers",
    "connections.ConnectionLimits.connections": "`doors.connections`, 32",
    "connections.ConnectionLimits.in_ten_seconds": "`doors.connections_in_ten_seconds`, 200",
    "door_node._ANSWER_SECONDS": "A call to a client's own service: 60 s",
    "door_node._LEFT_SECONDS": "ten seconds after its client left",
    "door_parameters._MAX_READ": "1000 parameters in one read",
    "door_parameters._MAX_READS": "8 waiting reads",
    "door_table._MAX_NAMES": "| 2000 |",
    "door_visits._MAX": "1000 valid ones",
    "requests.LONGEST_SECONDS": "at most 30 days",
    "door_visits._OPEN_SECONDS": "opens within 60 s",
    "door_visits._MAX_OF_PERSON": "8 of a person",
    "foxglove.FoxgloveLimits.subscriptions": "Foxglove 1000 subscriptions",
    "foxglove.FoxgloveLimits.channels": "200 channels",
    "foxglove.FoxgloveLimits.calls": "100 of a client",
    "foxglove.FoxgloveLimits.parameters": "1000 for a client",
    "known_types.MAX_CHARACTERS": "400,000 characters",
    "lookout._MAX_PROBES": "50 a second",
    "lookout._PROBE_SECONDS": "one second each",
    "lookout._AGAIN_SECONDS": "again after ten seconds",
    "door_node._LEARN_SECONDS": "one second each",
    "session.MAX_REFUSALS": "100 in 30 s",
    "session.REFUSAL_SECONDS": "100 in 30 s",
    "session._HELD_SECONDS": "(120 s)",
    "rosbridge.RosbridgeLimits.topics": "rosbridge 1000 topics",
    "rosbridge.RosbridgeLimits.ids": "100 ids of a topic",
    "rosbridge.RosbridgeLimits.services": "100 of a client",
    "rosbridge.RosbridgeLimits.will_bytes": "4096 bytes",
    "rosbridge.RosbridgeLimits.calls": "100 of a client",
    "rosbridge.RosbridgeLimits.call_seconds": "60 s, or the `timeout`",
    "rosbridge.RosbridgeLimits.longest_call_seconds": "up to 3600 s",
    "rosbridge_frames._MAX_CHARACTERS": "1024 characters",
    "session._LEAST_TAKEN": "less than 512 KB in five seconds",
    "session._TAKING_SECONDS": "less than 512 KB in five seconds",
    "session._MAX_PINGS": "does not read | 100 |",
    "session.SessionOptions.frame_bytes": "even after inflation | 8 MB",
    "session.SessionOptions.handshake_seconds": "handshake | 10 s",
    "session.SessionOptions.ping_seconds": "each 20 s",
    "session.SessionOptions.silent_seconds": "| 60 s; with a will 3 s",
    "session.SessionOptions.will_ping_seconds": "with a will each second",
    "session.SessionOptions.will_silent_seconds": "with a will 3 s",
    "settings.MAX_DOORS": "| doors | 32 |",
    "door_memory._SECONDS": "16 KB more in ten seconds",
    "door_memory._LEAST_SENT": "16 KB more in ten seconds",
    "door_memory._LEAST_SHARED": "256 KB if the client holds",
    "values.ValueLimits.message_bytes": "a message of a client | 16 MB",
    "values.ValueLimits.shown_bytes": "as JSON or CBOR 32 MB",
    "values.ValueLimits.values": "450,000 values in JSON",
}

_PACE = "it only paces the door's own work"
_OWN = "it bounds the door's or control's own memory; beyond it, nothing is refused"
INTERNAL = {
    "process.SAMPLE_SECONDS": _PACE,
    "connections._REFUSAL_SECONDS": "a refused connection has got its words by then",
    "connections._MAX_REFUSALS": "further refused connections end without words, within the same limits",
    "orders._LOOK_SECONDS": _PACE,
    "orders._RETRY_SECONDS": _PACE,
    "door_link.MAX_NODES": _PACE,
    "door_link.MAX_SHOWN": "`rosrv door list` shows the oldest ones",
    "door_node._LINGER_SECONDS": "a topic without a client ends then",
    "door_node._REPLAY_SECONDS": "older messages are not for new subscribers",
    "door_node._ASK_SECONDS": _PACE,
    "door_node._ASK_AGAIN_SECONDS": _PACE,
    "door_processes._CONNECT_SECONDS": "of control to itself",
    "door_processes._END_SECONDS": "of a process that was told to end",
    "door_processes._LONGEST": "of a message of its own process",
    "door_processes._MAX_PENDING": _PACE,
    "door_processes._MAX_DEATHS": _OWN,
    "door_processes._MAX_HOSTS": _OWN,
    "process._SECONDS": "of control to itself",
    "heard_topic._MAX_TOLD": "further types of a topic are dropped without words",
    "known_types._MAX_DIFFERING": "further differences of a second are not recorded; each topic is read all the same",
    "known_types._MAX_FAILURES": _OWN,
    "known_types._MAX_READ": _OWN,
    "known_types._MAX_DEFINED_CHARACTERS": _OWN,
    "lookout._FRESH_SECONDS": _PACE,
    "lookout._MAX_ROUNDS": _PACE,
    "node_hosts._SECONDS": "of control to itself",
    "process._AGAIN_SECONDS": _PACE,
    "process._REPORT_SECONDS": _PACE,
    "process._MAX_PEERS": "further peers of a second share one record",
    "session._MAX_TOPICS": _OWN,
    "rosbridge._MAX_TOLD": "further reasons come only with their id",
    "rosbridge_frames._MAX_INTEGER": "it is the type's own range",
    "session._CLOSING_SECONDS": _PACE,
    "session._LAST_SECONDS": _PACE,
    "session._LAST_TURN_SECONDS": _PACE,
    "session._WATCH_SECONDS": _PACE,
    "view.LATELY_SECONDS": "of an alarm",
    "view._FULL_SECONDS": "of an alarm",
    "view._MAX_NAMED": "of an alarm",
    "session.SessionOptions.origins": "no bound",
}


def bounds() -> list[str]:
    """Return the constants that look like bounds, and the fields of classes of limits."""
    found: list[str] = []
    for path in sorted(FOLDER.glob("*.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Assign | ast.AnnAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                names = [
                    one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)
                ]
                found += [f"{path.stem}.{name}" for name in names if _IS_BOUND.search(name)]
            elif isinstance(node, ast.ClassDef) and node.name.endswith(("Limits", "Options")):
                fields = [
                    one.target.id
                    for one in node.body
                    if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name)
                ]
                found += [f"{path.stem}.{node.name}.{name}" for name in fields]
    return found


def test_every_bound_is_in_the_table_or_has_a_reason() -> None:
    assert {*bounds()} == SHOWN.keys() | INTERNAL.keys()
    assert not SHOWN.keys() & INTERNAL.keys()


@pytest.mark.parametrize("name", SHOWN)
def test_the_table_has_the_bound(name: str) -> None:
    _before, _heading, rest = PAGE.read_text(encoding="utf-8").partition("## Limits\n")
    table = rest.partition("\n\nSo a door")[0]
    assert SHOWN[name] in table
