import asyncio
import contextlib
import tracemalloc

import pytest

from appliance.master.endpoints.delivery import ANSWER, NodeApiClient
from appliance.master.graph.registry import Registry
from appliance.rpc.xmlrpc_client import CallFailedError, UnansweredError, XmlRpcClient
from roswire.uris import NodeUri, parse_node_uri
from roswire.xmlrpc import build_response
from tests.support.incarnations import incarnation

pytestmark = [pytest.mark.anyio, pytest.mark.timeout(20)]
_EVERY = "/aZ09_.~!$&'()*+,;=:@%/-/"  # each character that a path may have


@pytest.mark.usefixtures("sockets")
@pytest.mark.parametrize("path", ["/%d/%s/%n", "/%", "/%%%(a)s", _EVERY])
async def test_a_path_is_sent_as_the_node_wrote_it(path: str) -> None:
    """A path belongs to its node, so a format string must not contain it."""
    heads: list[bytes] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        heads.append(await reader.readuntil(b"\r\n\r\n"))
        assert len(await reader.readexactly(int(heads[-1].rpartition(b"Content-Length: ")[2])))
        body = build_response([1, "", 7])
        writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n%b" % (len(body), body))
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    uri = parse_node_uri(f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}{path}")
    assert await XmlRpcClient(uri, timeout=2.0).call("getPid", "/me") == [1, "", 7]
    assert heads[0].split(b"\r\n")[0] == f"POST {path} HTTP/1.1".encode()
    server.close()


@pytest.mark.nightly
async def test_a_kept_connection_that_does_not_answer_is_given_up_in_time() -> None:
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

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    client = XmlRpcClient(NodeUri("http", "127.0.0.1", port, "/"), timeout=2.0, pool=1)
    assert await client.call("getPid", "/me") == [1, "", 1]
    with pytest.raises(UnansweredError, match=r"did not answer getPid within 2 s"):
        await client.call("getPid", "/me")
    await ended.get()
    assert await client.call("getPid", "/me") == [1, "", 3]
    client.close()
    await ended.get()
    server.close()


@pytest.mark.nightly
async def test_a_large_call_has_more_time() -> None:
    """A new ROS master reads all parameters in one long call."""
    small_failed = asyncio.Event()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = await reader.readuntil(b"\r\n\r\n")
        large = int(head.rpartition(b"Content-Length: ")[2].split()[0]) > 1 << 20
        with contextlib.suppress(asyncio.IncompleteReadError):
            await (small_failed.wait() if large else reader.read())
        body = build_response([1, "", 0])
        writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n%b" % (len(body), body))
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    client = XmlRpcClient(NodeUri("http", "127.0.0.1", port, "/"), timeout=1.0)
    large = asyncio.create_task(client.call("setParam", "/me", "/", "x" * (9 << 20)))
    with pytest.raises(UnansweredError):
        await client.call("setParam", "/me", "/", "x")
    small_failed.set()
    assert await large == [1, "", 0]
    client.close()
    server.close()


@pytest.mark.nightly
@pytest.mark.parametrize(
    "chunk", [b"1\r\nx\r\n", b"2000\r\n" + b"x" * 0x2000 + b"\r\n"], ids=["bytes", "blocks"]
)
def test_an_answer_without_end_is_read_to_its_limit(chunk: bytes) -> None:
    async def scene() -> None:
        sent = 0

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            nonlocal sent
            await reader.readuntil(b"\r\n\r\n")
            writer.write(b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n")
            with contextlib.suppress(ConnectionError):
                while True:
                    writer.write(chunk * 100)
                    await writer.drain()
                    sent += 100 * len(chunk)
            writer.close()

        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        node = incarnation("/node", port, host="127.0.0.1")
        client = NodeApiClient(Registry(), timeout=20).client(node)
        with pytest.raises(CallFailedError, match=f"the answer is larger than {ANSWER.body} bytes"):
            await client.call("getPid", "/me")
        server.close()

    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        asyncio.run(asyncio.wait_for(scene(), 20))
        assert tracemalloc.get_traced_memory()[1] - before < 4 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.nightly
async def test_a_deep_answer_of_a_node_is_refused() -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        body = build_response([1, "", [[[[0]]]]])
        writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n%b" % (len(body), body))
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    node = incarnation("/node", port, host="127.0.0.1")
    client = NodeApiClient(Registry(), timeout=20).client(node)
    with pytest.raises(CallFailedError, match="nonsense"):
        await client.call("getPid", "/me")
    server.close()
