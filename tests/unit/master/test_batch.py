"""Calls of one turn of the loop travel together."""

import asyncio
from typing import Any

import pytest

from appliance.master.rosmaster import BatchingClient
from appliance.ros.errors import EncodingError
from appliance.rpc.client import BrokenOffError, CallFailedError


class Server:
    """Answers as ROSMaster would, and remembers what travelled."""

    def __init__(self) -> None:
        self.travelled: list[tuple[str, tuple[Any, ...]]] = []
        self.broken = False

    async def call(self, method: str, *params: Any) -> Any:
        """Echo; the method `searchParam` is a fault."""
        self.travelled.append((method, params))
        if self.broken:
            raise BrokenOffError("gone")
        if method != "system.multicall":
            return [1, method, params[0]]
        return [
            {"faultCode": 1, "faultString": "no such thing"}
            if part["methodName"] == "searchParam"
            else [[1, part["methodName"], part["params"][0]]]
            for part in params[0]
        ]


def run(server: Server, *calls: tuple[str, Any]) -> list[Any]:
    """Make all calls in one turn; their outcomes."""

    async def scene() -> list[Any]:
        client = BatchingClient(server, {"hasParam", "searchParam", "lookupNode", "registerPublisher"})  # type: ignore[arg-type]  # the server stands for the connection
        return await asyncio.gather(*(client.call(*one) for one in calls), return_exceptions=True)

    return asyncio.run(scene())


def test_a_call_alone_travels_alone() -> None:
    """No multicall is made of one call."""
    server = Server()
    assert run(server, ("getPid", 7)) == [[1, "getPid", 7]]
    assert server.travelled == [("getPid", (7,))]


def test_calls_of_one_turn_travel_as_one_in_their_order() -> None:
    """Each caller gets its own answer; the order is the order of the calls."""
    server = Server()
    assert run(server, ("hasParam", 1), ("lookupNode", 2), ("hasParam", 3)) == [
        [1, "hasParam", 1],
        [1, "lookupNode", 2],
        [1, "hasParam", 3],
    ]
    [(method, (parts,))] = server.travelled
    assert method == "system.multicall"
    assert [part["methodName"] for part in parts] == ["hasParam", "lookupNode", "hasParam"]


def test_a_fault_is_its_own_callers_only() -> None:
    """One part fails, the others have their answers."""
    first, second, third = run(Server(), ("hasParam", 1), ("searchParam", 2), ("lookupNode", 3))
    assert first == [1, "hasParam", 1]
    assert isinstance(second, CallFailedError)
    assert "no such thing" in str(second)
    assert third == [1, "lookupNode", 3]


def test_a_broken_connection_is_everybodys_as_what_it_is() -> None:
    """Each caller learns that the connection broke, so that each can try again."""
    server = Server()
    server.broken = True
    outcomes = run(server, ("hasParam", 1), ("lookupNode", 2))
    assert [type(one) for one in outcomes] == [BrokenOffError, BrokenOffError]
    assert outcomes[0] is not outcomes[1]


@pytest.mark.parametrize("count", [63, 64, 65, 200])
def test_many_calls_are_split(count: int) -> None:
    """No multicall has more than 64 parts, and every call has its answer."""
    server = Server()
    outcomes = run(server, *(("lookupNode", one) for one in range(count)))
    assert outcomes == [[1, "lookupNode", one] for one in range(count)]
    assert max(len(params[0]) for method, params in server.travelled if method == "system.multicall") <= 64


def test_values_travel_alone() -> None:
    """A parameter's value, which may be large or impossible to write, takes nobody else's call with it."""
    server = Server()
    run(server, ("setParam", 1), ("hasParam", 2), ("getParam", 3), ("lookupNode", 4))
    assert sorted(method for method, _ in server.travelled) == ["getParam", "setParam", "system.multicall"]
    [parts] = [params[0] for method, params in server.travelled if method == "system.multicall"]
    assert [part["methodName"] for part in parts] == ["hasParam", "lookupNode"]


def test_what_cannot_be_written_is_the_callers_error() -> None:
    """Whatever goes wrong with a call, its caller hears it; nobody waits for ever."""

    async def call(_method: str, *_params: Any) -> Any:
        raise EncodingError("no notation")

    server = Server()
    server.call = call  # type: ignore[method-assign, assignment]  # a peer that cannot be written to
    outcomes = run(server, ("hasParam", None), ("lookupNode", None), ("setParam", None))
    assert [type(one) for one in outcomes] == [EncodingError] * 3
