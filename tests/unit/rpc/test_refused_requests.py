from dataclasses import replace

import pytest

from tests.support.http_server import LIMITS, Client, Server, fault, post, serving

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("sockets")]


@pytest.mark.parametrize(
    ("request_bytes", "status", "reason"),
    [
        (b"GET / HTTP/1.1\r\nHost: m\r\n\r\n", 405, "did not POST"),
        (b"CONNECT m:1 HTTP/1.1\r\nHost: m\r\n\r\n", 405, "did not POST"),
        (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03", 400, "not HTTP"),
        (b"\xaf\x00\x00\x00callerid=/x", 400, "not HTTP"),
        (post(b"", length=17 << 20), 413, "announced a body"),
        (post(b"", "Content-Encoding: gzip"), 415, "encoded as 'gzip'"),
        (post(b"", "Connection: upgrade", "Upgrade: h2c"), 501, "another protocol"),
        (b"POST / HTTP/1.1\r\nContent-Length: -5\r\n\r\n", 400, "not HTTP"),
        (b"POST / HTTP/1.1\r\nContent-Length: 1e3\r\n\r\n", 400, "not HTTP"),
        (b"POST / HTTP/1.1\r\nContent-Length: " + b"9" * 5000 + b"\r\n\r\n", 400, "not HTTP"),
        (b"POST / HTTP/1.1\r\nContent-Length: 3\r\nContent-Length: 4\r\n\r\nabcd", 400, "not HTTP"),
        (
            b"POST / HTTP/1.1\r\nContent-Length: 3\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
            400,
            "not HTTP",
        ),
        (b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n", 400, "not HTTP"),
        (b"POST / HTTP/1.1\r\nX:" + b"a" * 70_000, 431, "head beyond the limit"),
        (b"POST /" + b"a" * 70_000, 431, "head beyond the limit"),
        (b"POST /" + b"a" * 70_000 + b" HTTP/1.1\r\n\r\n", 431, "head beyond the limit"),
        (b"POST / HTTP/1.1\r\nX: " + b"a" * 70_000 + b"\r\n\r\n", 431, "head beyond the limit"),
        (b"POST / HTTP/1.1\r\n" + b"X: y\r\n" * 20_000, 431, "head beyond the limit"),
    ],
    ids=lambda value: repr(value[:40]) if isinstance(value, bytes) else None,
)
async def test_malformed(
    request_bytes: bytes, status: int, reason: str, server: Server, client: Client
) -> None:
    await client.send(request_bytes)
    code, _headers, body = await client.response()
    assert code == status
    assert reason in fault(body)
    assert await client.ended() == b""
    assert [reason in trouble for trouble in server.troubles] == [True], server.troubles
    assert not server.requests


async def test_nothing_is_served_after_a_refusal(server: Server, client: Client) -> None:
    await client.send(b"GET / HTTP/1.1\r\nHost: m\r\n\r\n" + post(b"smuggled"))
    assert (await client.response())[0] == 405
    await client.ended()
    assert not server.requests


async def test_a_request_before_a_malformed_one_is_answered_or_the_connection_ends(
    server: Server, client: Client
) -> None:
    await client.send(post(b"good") + b"\x00\x01rubbish\r\n\r\n")
    await client.ended()
    assert len(server.requests) <= 1


async def test_large_refused_body_still_gets_its_answer() -> None:
    async with serving(refusal=b"<fault/>") as server:
        client = await server.connect()
        client.writer.write(post(b"x" * (4 << 20)))
        status, headers, body = await client.response()
        assert (status, headers["connection"], body) == (200, "close", b"<fault/>")
        assert not server.requests
        assert server.beginnings == [b"x" * 4096]


async def test_a_refusal_gets_the_beginning_of_the_body() -> None:
    async with serving(refusal=b"<fault/>") as server:
        for pieces in ([post(b"<methodCall/>")], [post(b"", length=13), b"<method", b"Call/>"]):
            client = await server.connect()
            for piece in pieces:
                await client.send(piece)
            assert (await client.response())[2] == b"<fault/>"
        assert server.beginnings == [b"<methodCall/>"] * 2
        assert not server.requests


async def test_a_request_with_expect_is_refused_at_once() -> None:
    async with serving(refusal=b"<fault/>") as server:
        client = await server.connect()
        await client.send(post(b"", "Expect: 100-continue", length=1000))
        assert (await client.response())[2] == b"<fault/>"


async def test_refused_before_the_body() -> None:
    """A peer that no rule names gets the answer even if the rest of its request never comes."""
    async with serving(refusal=b"<fault/>") as server:
        client = await server.connect()
        await client.send(post(b"", length=1000))
        assert (await client.response())[2] == b"<fault/>"


async def test_chunked_body_beyond_the_limit() -> None:
    async with serving(limits=replace(LIMITS, body_bytes=100_000)) as server:
        client = await server.connect()
        await client.send(b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n")
        chunk = b"8000\r\n" + b"x" * 0x8000 + b"\r\n"
        for _ in range(5):
            client.writer.write(chunk)
        assert (await client.response())[0] == 413


@pytest.mark.parametrize(
    "framing", [b"1\r\nx\r\n", b"1;" + b"e" * 1000 + b"\r\nx\r\n"], ids=["tiny", "extension"]
)
async def test_more_framing_than_body(framing: bytes) -> None:
    async with serving(limits=replace(LIMITS, head_bytes=4096, body_bytes=1 << 16)) as server:
        client = await server.connect()
        client.writer.write(b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n" + framing * 20_000)
        assert (await client.response())[0] == 400
        assert "chunk sizes" in await server.trouble()


async def test_endless_trailer() -> None:
    async with serving(limits=replace(LIMITS, head_bytes=4096, body_bytes=1 << 16)) as server:
        client = await server.connect()
        client.writer.write(
            b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n0\r\nX: " + b"a" * 1_000_000
        )
        assert (await client.response())[0] == 400
