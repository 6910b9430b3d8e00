"""The first call is sent at once; small calls that arrive before its answer are sent together."""

import asyncio
from typing import Any

import pytest

from appliance.master.rosmaster import BatchingClient
from appliance.rpc.xmlrpc_client import BrokenOffError, CallFailedError
from roswire.errors import EncodingError

pytestmark = pytest.mark.anyio


class Server:
    """A connection that answers as the ROS master does, and records its requests."""

    def __init__(self) -> None:
        self.travelled: list[tuple[str, tuple[Any, ...]]] = []
        self.broken = False

    async def call(self, method: str, *params: Any) -> Any:
        """Echo the call after a turn of the loop; the method `searchParam` gives a fault."""
        await asyncio.sleep(0)
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
    """Make all calls in one turn, and return their outcomes."""

    async def scene() -> list[Any]:
        client = BatchingClient(server, {"hasParam", "searchParam", "lookupNode", "registerPublisher"})  # type: ignore[arg-type]  # the server stands for the connection
        return await asyncio.gather(*(client.call(*one) for one in calls), return_exceptions=True)

    return asyncio.run(scene())


def test_a_single_call_is_sent_alone() -> None:
    """One call is not wrapped in a multicall."""
    server = Server()
    assert run(server, ("getPid", 7)) == [[1, "getPid", 7]]
    assert server.travelled == [("getPid", (7,))]


def test_waiting_calls_are_sent_as_one_in_order() -> None:
    """The first call is sent at once; each caller gets its own answer, in the order of the calls."""
    server = Server()
    assert run(server, ("registerPublisher", 0), ("hasParam", 1), ("lookupNode", 2), ("hasParam", 3)) == [
        [1, "registerPublisher", 0],
        [1, "hasParam", 1],
        [1, "lookupNode", 2],
        [1, "hasParam", 3],
    ]
    [first, (method, (parts,))] = server.travelled
    assert first == ("registerPublisher", (0,))
    assert method == "system.multicall"
    assert [part["methodName"] for part in parts] == ["hasParam", "lookupNode", "hasParam"]


async def test_one_request_is_under_way_at_a_time() -> None:
    """Calls wait for the answer to the current request, even if its caller was cancelled."""
    server, go = Server(), asyncio.Event()
    answer = server.call

    async def slow(method: str, *params: Any) -> Any:
        if params == (1,):
            await go.wait()
        return await answer(method, *params)

    server.call = slow  # type: ignore[method-assign]  # a peer that takes its time
    client = BatchingClient(server, {"hasParam", "lookupNode"})  # type: ignore[arg-type]  # as in `run`
    calls = [asyncio.ensure_future(client.call("hasParam", one)) for one in (1, 2, 3)]
    for _ in range(5):
        await asyncio.sleep(0)
    assert server.travelled == []
    calls[1].cancel()
    go.set()
    assert [await calls[0], await calls[2]] == [[1, "hasParam", 1], [1, "hasParam", 3]]
    calls = [asyncio.ensure_future(client.call("lookupNode", one)) for one in (1, 2)]
    await asyncio.sleep(0)
    calls[0].cancel()
    assert await calls[1] == [1, "lookupNode", 2]
    assert await client.call("hasParam", 4) == [1, "hasParam", 4]


def test_a_fault_reaches_its_own_caller_only() -> None:
    """One part fails; the other callers get their answers."""
    _, first, second, third = run(
        Server(), ("hasParam", 0), ("hasParam", 1), ("searchParam", 2), ("lookupNode", 3)
    )
    assert first == [1, "hasParam", 1]
    assert isinstance(second, CallFailedError)
    assert "no such thing" in str(second)
    assert third == [1, "lookupNode", 3]


def test_a_broken_connection_is_reported_to_each_caller() -> None:
    """Each caller gets the error of the connection, so that it can retry."""
    server = Server()
    server.broken = True
    _, *outcomes = run(server, ("hasParam", 1), ("lookupNode", 2), ("lookupNode", 3))
    assert [type(one) for one in outcomes] == [BrokenOffError, BrokenOffError]
    assert outcomes[0] is not outcomes[1]


@pytest.mark.parametrize("count", [63, 64, 65, 200])
def test_many_calls_are_split(count: int) -> None:
    """No multicall has more than 64 parts, and every call has its answer."""
    server = Server()
    outcomes = run(server, *(("lookupNode", one) for one in range(count)))
    assert outcomes == [[1, "lookupNode", one] for one in range(count)]
    assert max(len(params[0]) for method, params in server.travelled if method == "system.multicall") <= 64


def test_values_are_sent_alone() -> None:
    """A value may be large or unserializable, so it is sent alone and cannot fail another caller's call."""
    server = Server()
    run(server, ("lookupNode", 0), ("setParam", 1), ("hasParam", 2), ("getParam", 3), ("lookupNode", 4))
    assert sorted(method for method, _ in server.travelled) == [
        "getParam",
        "lookupNode",
        "setParam",
        "system.multicall",
    ]
    [parts] = [params[0] for method, params in server.travelled if method == "system.multicall"]
    assert [part["methodName"] for part in parts] == ["hasParam", "lookupNode"]


def test_an_unserializable_call_is_its_callers_error() -> None:
    """Each failure reaches the caller of that call; no caller waits forever."""

    async def call(_method: str, *_params: Any) -> Any:
        raise EncodingError("no notation")

    server = Server()
    server.call = call  # type: ignore[method-assign, assignment]  # a peer that cannot be written to
    outcomes = run(server, ("hasParam", None), ("lookupNode", None), ("setParam", None))
    assert [type(one) for one in outcomes] == [EncodingError] * 3


def test_a_cancelled_call_is_not_sent() -> None:
    """A call that is cancelled while it waits is never sent."""
    server = Server()

    async def scene() -> None:
        client = BatchingClient(server, {"hasParam"})  # type: ignore[arg-type]  # the server stands for the connection
        calls = [asyncio.create_task(client.call("hasParam", number)) for number in range(4)]
        await asyncio.sleep(0)
        calls[2].cancel()
        await asyncio.gather(*calls, return_exceptions=True)

    asyncio.run(scene())
    [first, (_method, (parts,))] = server.travelled
    assert (first, [part["params"] for part in parts]) == (("hasParam", (0,)), [[1], [3]])
