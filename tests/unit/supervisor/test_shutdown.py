"""Tests of `appliance.supervisor.shutdown`, with processes that end by what a test says."""

import asyncio
import signal
from typing import cast

import pytest

from appliance.supervisor import shutdown
from appliance.supervisor.process_handle import Life
from appliance.supervisor.process_slot import Post
from appliance.supervisor.roles import Role


class Crowd:
    """Processes, and everything that was done to end them, in its order."""

    def __init__(self) -> None:
        self.posts: list[Post] = []
        self.died = asyncio.Event()
        self.done: list[tuple[str, str]] = []

    def add(self, name: str, ends_by: str, *, is_program: bool = False, last: bool = False) -> None:
        """One more, which ends by `Stop`, a signal's name, or nothing."""
        role = Role(name=name, user="rosrv", part=name, outlives_control=last)
        post = Post(role, 0)
        post.life = cast(Life, Process(self, post, ends_by, is_program=is_program))
        self.posts.append(post)

    def end(self) -> list[tuple[str, str]]:
        """What was done."""
        asyncio.run(shutdown.end_all(self.posts, self.died))
        return self.done


class Process:
    """A life of the crowd."""

    pid = 1

    def __init__(self, crowd: Crowd, post: Post, ends_by: str, *, is_program: bool) -> None:
        self.crowd, self.post, self.ends_by, self.is_program = crowd, post, ends_by, is_program

    def send(self, message: object) -> None:
        """Told to stop."""
        self._suffer(type(message).__name__)

    def kill(self, number: signal.Signals = signal.SIGKILL) -> None:
        """A signal."""
        self._suffer(number.name)

    def _suffer(self, what: str) -> None:
        self.crowd.done.append((self.post.role.name, what))
        if what == self.ends_by:
            self.post.life = None
            self.crowd.died.set()


@pytest.fixture
def crowd(monkeypatch: pytest.MonkeyPatch) -> Crowd:
    """Nobody yet; patience is short."""
    for name in ("_STOP_SECONDS", "_TERMINATE_SECONDS", "_LAST_SECONDS"):
        monkeypatch.setattr(shutdown, name, 0.05)
    return Crowd()


def test_each_is_asked_first_and_rosmaster_last(crowd: Crowd) -> None:
    """Ours by a message, programs by SIGTERM; who outlives control is asked when all others are gone."""
    crowd.add("rosmaster", "SIGTERM", is_program=True, last=True)
    crowd.add("control", "Stop")
    crowd.add("rosout", "SIGTERM", is_program=True)
    assert crowd.end() == [("control", "Stop"), ("rosout", "SIGTERM"), ("rosmaster", "SIGTERM")]


def test_who_does_not_end_is_made_to(crowd: Crowd) -> None:
    """SIGTERM, then SIGKILL, and those only who are still there."""
    crowd.add("relay", "SIGKILL")
    crowd.add("api", "SIGTERM")
    crowd.add("control", "Stop")
    assert crowd.end() == [
        *((name, "Stop") for name in ("relay", "api", "control")),
        *((name, "SIGTERM") for name in ("relay", "api")),
        ("relay", "SIGKILL"),
    ]
    assert all(post.life is None for post in crowd.posts)


def test_what_nothing_ends_does_not_hold_up_the_end(crowd: Crowd) -> None:
    """A process that the kernel itself cannot end (a broken disk) is left, and the others are ended."""
    crowd.add("control", "never")
    crowd.add("rosmaster", "Stop", last=True)
    done = crowd.end()
    assert ("control", "SIGKILL") in done
    assert done.index(("rosmaster", "Stop")) > done.index(("control", "SIGKILL"))


def test_a_life_that_was_due_does_not_begin(crowd: Crowd) -> None:
    """A restart that waits for its time is taken back."""

    async def scene() -> bool:
        crowd.add("relay", "Stop")
        post = crowd.posts[0]
        post.life = None
        post.due = asyncio.get_running_loop().call_later(60, lambda: None)
        await shutdown.end_all(crowd.posts, crowd.died)
        return post.due.cancelled()

    assert asyncio.run(scene())
