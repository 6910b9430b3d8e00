import asyncio
import struct
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from roswire.node import MessageType, NodeLimits, RosNode, ServiceFailedError, ServiceType, SourceNetwork
from roswire.standard import standard_definitions
from roswire.tcpros import Body
from tests.support.nodes import Client, RosSession
from tests.support.processes import Host
from tests.support.site import Site

CLIENTS: list[Client] = ["rospy", "roscpp"]
SECONDS = 20.0


@pytest.fixture
def ros(site: Site, tmp_path: Path) -> Iterator[RosSession]:
    with RosSession(site.master_uri, tmp_path, site.robot) as session:
        yield session


def on(host: Host, work: Callable[[], Awaitable[None]]) -> None:
    async def limited() -> None:
        async with asyncio.timeout(3 * SECONDS):
            await work()

    run: Any = getattr(host, "run", None)
    run(lambda: asyncio.run(limited()))


@asynccontextmanager
async def node(site: Site) -> AsyncIterator[RosNode]:
    made = RosNode(
        "/door",
        site.master_uri,
        SourceNetwork(site.robot.address),
        limits=NodeLimits(),
        shut_down=lambda reason: pytest.fail(f"shut down: {reason}"),
    )
    await made.start()
    try:
        yield made
    finally:
        await made.close()


def string(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


@pytest.mark.parametrize("client", CLIENTS)
def test_topics_in_both_directions(site: Site, ros: RosSession, client: Client) -> None:
    async def work() -> None:
        async with node(site) as door:
            heard: asyncio.Queue[tuple[Body, str]] = asyncio.Queue()
            await door.subscribe(
                "/chatter", lambda body, header: heard.put_nowait((body, header["message_definition"]))
            )
            await asyncio.to_thread(ros.talker, client, "/chatter")
            body, definition = await asyncio.wait_for(heard.get(), SECONDS)
            assert body.startswith(string("hello 1")[:4]) and b"hello " in body
            assert "string data" in definition
            string_type = MessageType.of(standard_definitions(), "std_msgs/String")
            publisher = await door.advertise("/answer", string_type, latched=True, queue=10)
            publisher.publish(string("good morning"))
            listener = await asyncio.to_thread(ros.listener, client, "/answer")
            event = await asyncio.to_thread(listener.wait_for, event="received")
            assert event["data"] == "good morning"
            await asyncio.to_thread(listener.stop)

    on(site.robot, work)


@pytest.mark.parametrize("client", CLIENTS)
def test_services_in_both_directions(site: Site, ros: RosSession, client: Client) -> None:
    async def work() -> None:
        async with node(site) as door:
            await asyncio.to_thread(ros.service_server, client, "/theirs")
            header = await door.probe_service("/theirs")
            assert header["type"] == "std_srvs/SetBool"
            assert (await door.call_service("/theirs", header["md5sum"], b"\x01", SECONDS))[:1] == b"\x00"
            kind = ServiceType.of(standard_definitions(), "std_srvs/SetBool")

            async def answer(request: bytes) -> bytes:
                if request == b"\x00":
                    raise ServiceFailedError("the arm is blocked")
                return b"\x01" + string("done")

            await door.offer("/ours", kind, answer)
            caller = await asyncio.to_thread(ros.service_client, client, "/ours")
            caller.send("true")
            assert (await asyncio.to_thread(caller.wait_for, event="answered"))["message"] == "done"
            caller.send("false")
            failed = await asyncio.to_thread(caller.wait_for, event="failed")
            if client == "rospy":  # roscpp has no access to the reason
                assert "the arm is blocked" in failed["reason"]

    on(site.robot, work)
