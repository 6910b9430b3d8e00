import socket
from pathlib import Path
from typing import cast

import pytest

from appliance.channel.messages import LogHeld
from appliance.supervisor.process_handle import ProcessHandle
from appliance.supervisor.role import Facts, Role
from appliance.supervisor.roles import roles_of
from appliance.supervisor.supervisor import Supervisor

pytestmark = pytest.mark.usefixtures("sockets")

READER = Role("reader", "rosrv-syslog", "reader", "reader:main", dispensable=True, group="rosrv-api")


class _Life:
    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.killed = False

    def kill(self) -> None:
        self.killed = True


@pytest.mark.parametrize(
    ("holding", "ended"),
    [
        (["api"], {"api"}),
        (["reader"], {"reader"}),
        (["api", "reader", "relay", "control", "charon", "signer"], {"api", "reader"}),
        (["relay"], set()),
        ([-1], {"api", "reader"}),
        ([4_000_000], {"api", "reader"}),
    ],
)
def test_only_readers_of_the_log_are_ended(tmp_path: Path, holding: list[str | int], ended: set[str]) -> None:
    admin = socket.create_server(("127.0.0.1", 0))
    facts = Facts(state=tmp_path, config=tmp_path / "c", rosmaster_port=1)
    supervisor = Supervisor((*roles_of(), READER), facts, admin=admin, ready=lambda _said: None)
    try:
        starts = {}
        for number, slot in enumerate(supervisor.slots):
            starts[slot.role.name] = _Life(1000 + number)
            slot.process = cast(ProcessHandle, starts[slot.role.name])
        named = [one if isinstance(one, int) else starts[one].pid for one in holding]
        supervisor.control_said(cast(ProcessHandle, starts["control"]), LogHeld(named), ())
        assert {role for role, process in starts.items() if process.killed} == ended
    finally:
        supervisor.kept.close()
