import signal
import socket
from pathlib import Path

import pytest

from appliance.base import clock
from appliance.channel.messages import LeaseEnded, LeaseHeld, Message, ServicePaused
from appliance.features.standby.pairing import LeaseWatch
from appliance.supervisor import supervisor as module
from appliance.supervisor.role import Facts, Role
from appliance.supervisor.supervisor import Supervisor
from tests.support.memory_child import MemoryChild

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("local_sockets")]

CONTROL = Role(name="control", user="rosrv", part="control", entry="m:f")


@pytest.mark.parametrize("end", ["renewed", "a death", "a new epoch", "a stop"])
async def test_a_lapse_of_the_lease_stops_what_serves_the_robot(
    tmp_path: Path, end: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A renewal in the same epoch lets the service continue; otherwise it is killed. The api answers all along."""
    roles = (
        CONTROL,
        Role("relay", "u", "p", "m:f"),
        Role("lease", "u", "p", "m:f", outlives_takeover=True),
        Role("api", "u", "p", "m:f", stands_by=True),
        Role("rosout", "u", "p", "m:f", after="control"),  # not started yet, as soon after an activation
    )
    admin = socket.create_server(("127.0.0.1", 0))
    facts = Facts(state=tmp_path, config=tmp_path / "config.json", rosmaster_port=1)
    supervisor = Supervisor(roles, facts, admin=admin, ready=lambda _said: None, gate=LeaseWatch)
    control, relay, lease, api = children = [
        MemoryChild(role.name, supervisor.reports) for role in roles[:-1]
    ]
    for slot, child in zip(supervisor.slots[:-1], children, strict=True):
        slot.process, child.handle.ready = child.handle, True

    def report(message: Message) -> None:
        supervisor.reports.received(lease.handle, message, ())

    report(LeaseHeld(clock.since_boot() + 60, 5))
    report(LeaseEnded(renewable=True))
    assert [child.signals for child in children] == [[signal.SIGSTOP], [signal.SIGSTOP], [], []]
    supervisor.start(supervisor.slots[1])
    assert supervisor.slots[1].due is not None  # a start that was due waits
    supervisor.slots[1].due.cancel()
    if end == "a death":
        relay.end(-9)
        supervisor.slots[1].due.cancel()
    elif end == "a stop":

        async def end_none(*_processes: object, **_how: object) -> None:
            pass

        monkeypatch.setattr(module, "end_all", end_none)
        await supervisor.end()
    else:
        report(LeaseHeld(clock.since_boot() + 60, 5 if end == "renewed" else 7))
    assert control.signals[1:] == [signal.SIGCONT if end == "renewed" else signal.SIGKILL]
    assert lease.signals == []
    assert [type(message) for message in api.told] == [ServicePaused] * (1 if end == "a stop" else 2)
    assert signal.SIGSTOP not in api.signals
    supervisor.kept.close()
