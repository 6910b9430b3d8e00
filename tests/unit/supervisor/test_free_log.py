import socket
from pathlib import Path

import pytest

from appliance.channel.messages import LogHeld
from appliance.supervisor.role import Facts, Role
from appliance.supervisor.roles import roles_of
from appliance.supervisor.supervisor import Supervisor
from tests.support.memory_child import MemoryChild

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("local_sockets")]

READER = Role("reader", "rosrv-syslog", "reader", "reader:main", dispensable=True, group="rosrv-api")


@pytest.mark.parametrize(
    ("holding", "ended"),
    [
        (["api"], {"api"}),
        (["reader"], {"reader"}),
        (["api", "reader", "relay", "control", "signer"], {"api", "reader"}),
        (["relay"], set()),
        ([-1], {"api", "reader"}),
        ([4_200_000], {"api", "reader"}),
    ],
)
async def test_only_readers_of_the_log_are_ended(
    tmp_path: Path, holding: list[str | int], ended: set[str]
) -> None:
    admin = socket.create_server(("127.0.0.1", 0))
    facts = Facts(state=tmp_path, config=tmp_path / "c", rosmaster_port=1)
    supervisor = Supervisor((*roles_of(), READER), facts, admin=admin, ready=lambda _said: None)
    try:
        children = {slot.role.name: MemoryChild(slot.role.name) for slot in supervisor.slots}
        for slot in supervisor.slots:
            slot.process = children[slot.role.name].handle
        pids = [holder if isinstance(holder, int) else children[holder].pid for holder in holding]
        supervisor.control_said(children["control"].handle, LogHeld(pids), ())
        assert {role for role, child in children.items() if child.is_killed} == ended
    finally:
        supervisor.kept.close()
