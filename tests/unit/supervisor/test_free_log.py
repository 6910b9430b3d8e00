"""Tests of what the supervisor does with processes that keep the audit log locked."""

import socket
from pathlib import Path
from typing import cast

import pytest

from appliance.channel.messages import LogHeld
from appliance.supervisor.process_handle import Life
from appliance.supervisor.roles import Facts, roles_of
from appliance.supervisor.supervisor import Supervisor


class _Life:
    """Stands in for a process."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.killed = False

    def kill(self) -> None:
        """Note it."""
        self.killed = True


@pytest.mark.parametrize(
    ("holding", "ended"),
    [
        (["api"], {"api"}),
        (["syslog"], {"syslog"}),
        (["api", "syslog", "relay", "control", "charon", "signer"], {"api", "syslog"}),
        (["relay"], set()),
        ([-1], {"api", "syslog"}),
        ([4_000_000], {"api", "syslog"}),
    ],
)
def test_only_readers_of_the_log_are_ended(tmp_path: Path, holding: list[str | int], ended: set[str]) -> None:
    """The one that is named, all where the kernel does not know who or names a stranger; nobody else by any name."""
    admin = socket.create_server(("127.0.0.1", 0))
    facts = Facts(state=tmp_path, config=tmp_path / "c", rosmaster_port=1)
    supervisor = Supervisor(roles_of(syslog=True), facts, admin=admin, ready=lambda _said: None)
    try:
        lives = {}
        for number, post in enumerate(supervisor.posts):
            lives[post.role.name] = _Life(1000 + number)
            post.life = cast(Life, lives[post.role.name])
        named = [one if isinstance(one, int) else lives[one].pid for one in holding]
        supervisor.control_said(cast(Life, lives["control"]), LogHeld(named), ())
        assert {role for role, life in lives.items() if life.killed} == ended
    finally:
        supervisor.kept.close()
