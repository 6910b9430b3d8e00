"""Tests of `appliance.supervisor.supervisor` where a moment matters that real processes hit seldom."""

import asyncio
import socket
from pathlib import Path

import pytest

from appliance.supervisor.roles import Facts, Role
from appliance.supervisor.supervisor import Supervisor

ROSMASTER = Role(name="rosmaster", user="rosmaster", part="rosmaster", entry="m:f", asks=True)


class StandIn:
    """A life that only counts how often it was heard."""

    def __init__(self) -> None:
        self.heard_of = 0

    def heard(self) -> None:
        """Counted."""
        self.heard_of += 1


def made(tmp_path: Path, role: Role) -> Supervisor:
    """A supervisor of one process, not started."""
    admin = socket.create_server(("127.0.0.1", 0))
    facts = Facts(state=tmp_path, config=tmp_path / "config.json", rosmaster_port=1)
    return Supervisor((role,), facts, admin=admin, ready=lambda _said: None)


def test_a_master_that_dies_while_it_is_asked_is_asked_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The answer came from a life that is over: the start waits for the next one, and does not break."""

    async def scene() -> tuple[StandIn, StandIn]:
        supervisor = made(tmp_path, ROSMASTER)
        post = supervisor._posts[0]
        first, second = StandIn(), StandIn()
        asked = asyncio.Event()

        async def answers(_seconds: float) -> bool:
            if post.life is first:
                post.life = None  # it died while it was asked
                asked.set()
            return True

        monkeypatch.setattr(supervisor, "_answers", answers)
        post.life = first  # type: ignore[assignment]  a stand-in
        waiting = asyncio.create_task(supervisor._until_answering(post))
        async with asyncio.timeout(20):
            await asked.wait()
            post.life = second  # type: ignore[assignment]  a stand-in
            await waiting
        return first, second

    first, second = asyncio.run(scene())
    assert (first.heard_of, second.heard_of) == (0, 1)
