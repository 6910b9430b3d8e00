"""Tests of `appliance.rpc.client`."""

import asyncio
import contextlib

import pytest

from appliance.ros.uris import NodeUri
from appliance.ros.xmlrpc import build_response
from appliance.rpc.client import UnansweredError, XmlRpcClient


def test_a_kept_connection_that_does_not_answer_is_given_up_in_time() -> None:
    """The call's time counts on a kept connection, too; it is closed then, and the next call has another."""
    asked = 0
    ended: asyncio.Queue[None] = asyncio.Queue()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal asked
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionResetError):
            while True:
                head = await reader.readuntil(b"\r\n\r\n")
                await reader.readexactly(int(head.rpartition(b"Content-Length: ")[2]))
                asked += 1
                body = build_response([1, "", asked])
                if asked != 2:
                    writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n%b" % (len(body), body))
        ended.put_nowait(None)
        writer.close()

    async def scene() -> None:
        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        client = XmlRpcClient(NodeUri("http", "127.0.0.1", port, "/"), timeout=0.2, pool=1)
        assert await client.call("getPid", "/me") == [1, "", 1]
        with pytest.raises(UnansweredError, match=r"did not answer getPid within 0\.2 s"):
            await client.call("getPid", "/me")
        await ended.get()
        assert await client.call("getPid", "/me") == [1, "", 3]
        client.close()
        await ended.get()
        server.close()

    asyncio.run(asyncio.wait_for(scene(), 20))


def test_what_is_large_has_more_time() -> None:
    """Else a ROSMaster would never have all parameters again: it is told them in one call, and reads for a while."""
    small_failed = asyncio.Event()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = await reader.readuntil(b"\r\n\r\n")
        large = int(head.rpartition(b"Content-Length: ")[2].split()[0]) > 1 << 20
        with contextlib.suppress(asyncio.IncompleteReadError):
            await (small_failed.wait() if large else reader.read())
        body = build_response([1, "", 0])
        writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n%b" % (len(body), body))
        writer.close()

    async def scene() -> None:
        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        client = XmlRpcClient(NodeUri("http", "127.0.0.1", port, "/"), timeout=0.2)
        large = asyncio.create_task(client.call("setParam", "/me", "/", "x" * (9 << 20)))
        with pytest.raises(UnansweredError):
            await client.call("setParam", "/me", "/", "x")
        small_failed.set()
        assert await large == [1, "", 0]
        client.close()
        server.close()

    asyncio.run(asyncio.wait_for(scene(), 20))
