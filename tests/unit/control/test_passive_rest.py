"""Tests of `appliance.control.passive_rest`: the api of a standby knows the replicated tokens."""

import asyncio
import socket
import time
from pathlib import Path
from typing import Any

import pytest

from appliance.channel import admin
from appliance.channel.answers.standby_answers import StandbyState
from appliance.channel.channel import Channel
from appliance.channel.messages.api import ApiLink, RequestAnswered, RequestMade, TokensStated
from appliance.control.lease_client import HandOverError
from appliance.control.passive_rest import PassiveRest, ReplicatedTokens
from appliance.control.standby_orders import StandbyAdministration
from appliance.store.access_tokens import make_token
from appliance.store.state_file import StateStore
from tests.support.answers import example

pytestmark = pytest.mark.anyio


class Standby:
    """A standby that hands nothing over."""

    def state(self) -> StandbyState:
        """Return its state."""
        return example(StandbyState, role="standby", other={"name": "a", "address": "10.0.0.1"})

    async def hand_over(self) -> None:
        """Raise `HandOverError`."""
        raise HandOverError("not now")


async def test_a_new_api_learns_the_tokens_at_once(tmp_path: Path) -> None:
    """Its first message has every replicated token: with an empty list, users would be signed out.

    A request with such a token gets the active appliance's address.
    """
    row, token = make_token("alice", "viewer", now=time.time(), seconds=60)
    store = StateStore(tmp_path, failed=pytest.fail)
    store.save_tokens(row)
    store.close()
    rest = PassiveRest(
        StandbyAdministration(Standby(), orders=False), ReplicatedTokens(tmp_path / "state.db")
    )
    ours, theirs = socket.socketpair()
    heard: asyncio.Queue[Any] = asyncio.Queue()
    api = Channel(theirs, ApiLink)
    api.attach(
        asyncio.get_running_loop(), lambda message, _descriptors: heard.put_nowait(message), lambda: None
    )
    rest.attach(Channel(ours, ApiLink))
    async with asyncio.timeout(20):
        first = await heard.get()
        assert isinstance(first, TokensStated)
        assert [one.name for one in first.tokens] == ["alice"]
        api.send(RequestMade(7, admin.StatusWanted(), token))
        answer = await heard.get()
    assert isinstance(answer, RequestAnswered)
    assert admin.decode(answer.answer, admin.StatusWanted()).active == "10.0.0.1"
    api.close()
