"""Tests of `appliance.supervisor.process_slot`: how long a place stays empty."""

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from appliance.supervisor.process_slot import LOUD_AFTER, Post
from appliance.supervisor.roles import Facts, Role


def life(*, lived: float) -> Any:
    """A life that began so many seconds ago."""
    return SimpleNamespace(started=time.monotonic() - lived, since="2026-01-01T00:00:00.000Z")


@pytest.fixture
def post() -> Post:
    """The second relay's place."""
    return Post(Role(name="relay", user="rosrv-relay", part="relay", entry="m:f", indexed=True), 1)


def test_who_dies_at_once_waits_longer_up_to_a_second(post: Post) -> None:
    """The first successor comes without delay; who dies again and again waits, and somebody is told."""
    delays = []
    for _ in range(LOUD_AFTER):
        assert not post.keeps_dying
        post.bury(life(lived=0.1))
        delays.append(post.delay())
    assert delays == [0.0, 0.2, 0.5, 1.0, 1.0]
    assert post.keeps_dying


def test_what_others_can_do_without_waits_up_to_a_minute() -> None:
    """A tunnel process that dies on every start comes ever later, and is failing until a life of it lasts."""
    post = Post(Role(name="charon", user="rosrv-ipsec", part="ipsec", entry="m:f", dispensable=True), 0)
    delays = []
    for _ in range(14):
        post.bury(life(lived=0.1))
        delays.append(post.delay())
    assert delays[LOUD_AFTER - 1 :] == [2.0, 4.0, 8.0, 16.0, 32.0, *[60.0] * 5]
    post.reason = "it has no device"
    for lived, lasts in ((1.0, False), (60.0, True), (60.0, False)):
        post.life = life(lived=lived)
        assert post.recovers() == lasts
    assert (post.short_lives, post.reason) == (0, "")


def test_a_long_life_is_followed_at_once(post: Post) -> None:
    """What was before it is forgotten."""
    for _ in range(LOUD_AFTER):
        post.bury(life(lived=0.1))
    assert post.bury(life(lived=60)) == pytest.approx(60, abs=5)
    assert post.delay() == 0.0
    assert not post.keeps_dying


def test_a_plan_has_the_number_of_an_indexed_role_only(post: Post) -> None:
    """One of several is told which it is."""
    facts = Facts(state=Path("/state"), config=Path("/state/run/config.json"), rosmaster_port=1)
    assert post.plan(facts, 3).index == 1
    alone = Post(Role(name="signer", user="rosrv-signer", part="signer", entry="m:f"), 0)
    assert alone.plan(facts, 3).index is None
    assert alone.plan(facts, 3).home == "/state/signer"
