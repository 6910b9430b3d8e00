"""Tests of `appliance.supervisor.supervisor` where a moment matters that real processes hit seldom."""

import asyncio
import errno
import socket
from collections.abc import Callable, MutableMapping
from pathlib import Path
from typing import Any, cast

import pytest
from structlog.testing import capture_logs

from appliance.channel.messages import CompilerWanted, RouteWanted
from appliance.supervisor import supervisor as module
from appliance.supervisor.errors import StartError
from appliance.supervisor.process_handle import Life
from appliance.supervisor.roles import Facts, Role
from appliance.supervisor.supervisor import ControlReady, Supervisor

READY = ControlReady("http://127.0.0.1:11311", 1, "http://127.0.0.1:2", 3, 4, "secret")
CONTROL = Role(name="control", user="rosrv", part="control", entry="m:f")
ROSMASTER = Role(name="rosmaster", user="rosmaster", part="rosmaster", entry="m:f", asks=True)


class StandIn:
    """A life that only counts how often it was heard."""

    alive = True
    role = "control"

    def __init__(self) -> None:
        self.heard_of = 0
        self.told: list[str] = []
        self.killed = False
        self.pid = 1
        self.since = ""
        self.reason = ""
        self.output: tuple[str, ...] = ()
        self.ready = False
        self.still_seconds = 0.0

    def kill(self) -> None:
        """Noted."""
        self.killed = True

    def send(self, message: object, _descriptors: tuple[int, ...] = ()) -> None:
        """Noted by its kind."""
        self.told.append(type(message).__name__)

    def heard(self) -> None:
        """Counted."""
        self.heard_of += 1


def made(
    tmp_path: Path, role: Role, ready: Callable[[ControlReady], None] = lambda _said: None
) -> Supervisor:
    """A supervisor of one process, not started."""
    admin = socket.create_server(("127.0.0.1", 0))
    facts = Facts(state=tmp_path, config=tmp_path / "config.json", rosmaster_port=1)
    return Supervisor((role,), facts, admin=admin, ready=ready)


def test_a_master_that_dies_while_it_is_asked_is_asked_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The answer came from a life that is over: the start waits for the next one, and does not break."""

    async def scene() -> tuple[StandIn, StandIn]:
        supervisor = made(tmp_path, ROSMASTER)
        post = supervisor.posts[0]
        first, second = StandIn(), StandIn()
        asked = asyncio.Event()

        async def answers(_seconds: float) -> bool:
            if not asked.is_set():
                post.life = None  # it died while it was asked
                asked.set()
            return True

        monkeypatch.setattr(supervisor, "answers", answers)
        post.life = cast(Life, first)
        waiting = asyncio.create_task(supervisor.until_answering(post))
        async with asyncio.timeout(20):
            await asked.wait()
            post.life = cast(Life, second)
            await waiting
        return first, second

    first, second = asyncio.run(scene())
    assert (first.heard_of, second.heard_of) == (0, 1)


def test_a_first_token_that_cannot_be_kept_ends_the_start_in_words(tmp_path: Path) -> None:
    """Control is not told that it was announced, so the next start makes another; nobody waits for a ready line."""

    def ready(_said: ControlReady) -> None:
        raise StartError("the first access token cannot be written")

    async def scene() -> StandIn:
        supervisor, control = made(tmp_path, CONTROL, ready), StandIn()
        await supervisor.control_ready(cast(Life, control), READY)
        assert supervisor.failure == "the first access token cannot be written"
        assert not supervisor.is_ready
        return control

    assert "Announced" not in asyncio.run(scene()).told


def test_a_machine_without_processes_is_not_asked_in_a_tight_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that cannot even be made is tried again as one that dies at once is: slower each time."""

    def none_left(*_arguments: object) -> Life:
        raise OSError(errno.EAGAIN, "no process can be made")

    async def scene() -> list[float]:
        supervisor = made(tmp_path, CONTROL)
        monkeypatch.setattr(module, "Life", none_left)
        (post,), delays = supervisor.posts, []
        for _ in range(5):
            supervisor.fill(post)
            assert post.due is not None
            delays.append(round(post.due.when() - asyncio.get_running_loop().time(), 1))
            post.due.cancel()
        return delays

    assert asyncio.run(scene()) == [0.0, 0.2, 0.5, 1.0, 1.0]


def test_a_control_that_asks_for_too_much_at_once_is_replaced(tmp_path: Path) -> None:
    """What is not answered yet has a bound; what was asked before it is answered."""

    async def scene() -> tuple[StandIn, int]:
        supervisor, control = made(tmp_path, CONTROL), StandIn()
        for number in range(10_000):
            supervisor.control_said(cast(Life, control), RouteWanted(f"10.0.0.{number}"), ())
            if control.killed:
                return control, number
        return control, -1

    control, asked = asyncio.run(scene())
    assert control.killed
    assert 1000 < asked < 5000


def test_a_slow_start_is_waited_for_with_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While a process gets on, the log says what is waited for; when nothing gets on, the end names it."""
    monkeypatch.setattr(module, "_START_SECONDS", 0.0)
    monkeypatch.setattr(module, "_LOOK_SECONDS", 0.01)

    async def scene() -> tuple[list[str], list[MutableMapping[str, Any]]]:
        supervisor, slow, reasons = made(tmp_path, CONTROL), StandIn(), list[str]()
        supervisor.posts[0].life = cast(Life, slow)

        def stop(reason: str) -> None:
            reasons.append(reason)
            supervisor.stopping.set()

        monkeypatch.setattr(supervisor, "stop", stop)
        with capture_logs() as said:
            waiting = asyncio.create_task(supervisor.until_ready())
            async with asyncio.timeout(20):
                while len(said) < 2:
                    await asyncio.sleep(0)
                assert reasons == []
                slow.still_seconds = 1000.0
                await waiting
        return reasons, said

    reasons, said = asyncio.run(scene())
    assert {**said[0], "seconds": 0} == {
        "event": "still starting", "waits_for": "control", "seconds": 0, "log_level": "info",
    }  # fmt: skip
    (reason,) = reasons
    assert "it waited for control" in reason


@pytest.mark.parametrize("wanted", [False, True])
def test_who_is_there_on_demand_ends_by_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wanted: bool
) -> None:
    """Its end is no death: nobody follows but where one was asked for meanwhile, and it is counted as no restart."""
    role = Role(name="compiler", user="rosrv-compiler", part="compiler", entry="m:f", on_demand=True)
    asyncio.run(_end_by_themselves(made(tmp_path, role), monkeypatch, wanted))


async def _end_by_themselves(supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch, wanted: bool) -> None:
    [post] = supervisor.posts
    filled: list[int] = []
    monkeypatch.setattr(supervisor, "fill", lambda post: filled.append(post.lives))
    control = cast(Life, StandIn())
    supervisor.control_said(control, CompilerWanted(), ())
    assert filled == [0]
    post.life, post.lives = cast(Life, StandIn()), 1
    cast(Any, post.life).started = 0.0
    if wanted:
        supervisor.control_said(control, CompilerWanted(), ())
    supervisor.died(post.life, 0)
    assert filled == [0] + [0] * wanted
    assert post.is_vacant
    assert post.lives == 0
    post.life, post.lives = cast(Life, StandIn()), 1
    cast(Any, post.life).started = 0.0
    supervisor.died(post.life, -9)
    assert post.due is not None  # a death is followed by a life
    post.due.cancel()
    supervisor.kept.close()
