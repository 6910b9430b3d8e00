"""Control's part of doors on real parts, with the door `alice` and its process at the end of a link in memory."""

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from appliance.channel.channel import ChannelFullError
from appliance.channel.messages import Message
from appliance.control.core import Links
from appliance.control.links.supervisor_link import ControlLifeline
from appliance.features.doors import door_link
from appliance.features.doors.door_processes import ROLE, DoorProcesses
from appliance.features.doors.door_table import DoorRow, DoorTable
from appliance.features.doors.settings import Doors
from appliance.policy.model import address_of
from appliance.policy.policy_compiler import compile_policy
from appliance.specifications.in_force import InForce
from appliance.specifications.specification_files import Sources
from tests.support.core import FakeTrail
from tests.support.feature_parts import EMPTY, idle_core
from tests.support.idle import idle
from tests.support.memory_channel import memory_link

ALICE = DoorRow("alice", "198.19.240.2", 1.0, None, 0, None, "")


HOSTS = {
    "/base": address_of("127.0.0.1"),
    "/guest": address_of("10.0.0.66"),
    "/other": address_of("10.0.0.67"),
}


class DoorSite:
    """`sent` are the messages to the process, `asked` those to the supervisor, and `made` the ports of sockets."""

    def __init__(self, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.sent: list[Any] = []
        self.asked: list[Message] = []
        self.made: list[int] = []
        self.left: list[tuple[str, str]] = []
        self.trail = FakeTrail()
        lifeline = idle(ControlLifeline)
        monkeypatch.setattr(lifeline, "say", self.asked.append)
        links = Links(lifeline, lambda _sequence: None)
        core = idle_core(home)
        graph = replace(core.graph, host_of=HOSTS.get)
        self.core = replace(core, trail=self.trail, links=links, graph=graph)
        self.policies = self.core.policy.revisions
        self.policies.policy.set(compile_policy(f"{EMPTY}[Ports]\nrange = 19001-20000\n", file="policy"))
        self.table = DoorTable(self.core.store, Doors())
        self.table.closed = ""
        self.table.save(ALICE)
        tickets = ["3f9a0c5d17e2"]
        self.processes = DoorProcesses(
            self.core, self.table, tickets=lambda _door: tickets, left=lambda *left: self.left.append(left)
        )
        self._monkeypatch = monkeypatch
        monkeypatch.setattr(self.processes, "_given", self._given)

    async def _given(self, _slot: object, row: DoorRow, _request: int, port: int) -> None:
        assert row == ALICE
        self.made.append(port)

    def connect(self) -> None:
        """Give control a new link to a process."""
        self.channel, self.process = memory_link(door_link.DoorLink)
        self.process.attach(
            asyncio.get_running_loop(), lambda message, _descriptors: self.sent.append(message), lambda: None
        )
        attached = self.core.links.of(ROLE, 0)
        assert attached is not None
        attached[0].attach(self.channel)

    async def hears(self, *said: Message) -> None:
        for message in said:
            self.process.send(message)
        await settled()

    async def loses(self) -> None:
        """Let control lose the link."""
        self.process.close()
        await settled()

    async def ends(self) -> None:
        """Let the process end, and the next one of its slot start."""
        await self.loses()
        self.connect()

    def fill(self) -> None:
        """Let the process read nothing more."""

        def full(*_message: object, **_when: bool) -> None:
            raise ChannelFullError("the process does not read")

        self._monkeypatch.setattr(self.channel, "send", full)

    def define(self, **definitions: str) -> None:
        """Bring specifications with these definitions into force."""
        self.core.specifications.now = InForce(sources=Sources(definitions=definitions))
        self.processes.define()

    def change_rights(self) -> None:
        for listener in self.core.policy.listeners:
            listener()


async def settled() -> None:
    for _ in range(4):
        await asyncio.sleep(0)
