import signal
import socket
from pathlib import Path
from typing import cast

import pytest

from appliance.base import clock
from appliance.channel.messages import LeaseEnded, LeaseHeld, Message
from appliance.features.standby.lease_watch import LeaseWatch
from appliance.supervisor import supervisor as module
from appliance.supervisor.process_handle import ProcessHandle
from appliance.supervisor.role import Facts, Role
from appliance.supervisor.supervisor import Supervisor
from tests.unit.supervisor.test_supervisor import CONTROL, StandIn

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("sockets")]


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
    control, relay, lease, api = stand_ins = [StandIn() for _ in roles[:-1]]
    for slot, process in zip(supervisor.slots[:-1], stand_ins, strict=True):
        slot.process, process.ready, process.role = cast(ProcessHandle, process), True, slot.role.name

    def report(message: Message) -> None:
        supervisor.reports.received(cast(ProcessHandle, lease), message, ())

    report(LeaseHeld(clock.since_boot() + 60, 5))
    report(LeaseEnded(renewable=True))
    assert [one.signals for one in stand_ins] == [[signal.SIGSTOP], [signal.SIGSTOP], [], []]
    supervisor.start(supervisor.slots[1])
    assert supervisor.slots[1].due is not None  # a start that was due waits
    supervisor.slots[1].due.cancel()
    if end == "a death":
        supervisor.died(cast(ProcessHandle, relay), -9)
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
    assert (api.told, signal.SIGSTOP in api.signals) == (
        ["ServicePaused"] * (1 if end == "a stop" else 2),
        False,
    )
    supervisor.kept.close()
