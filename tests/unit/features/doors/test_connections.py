import asyncio

import pytest

from tests.support.features.doors.door_world import DOOR, DoorWorld, WebSocketClient

pytestmark = pytest.mark.anyio
SLOTS = 32


async def test_a_host_leaves_connections_for_others(world: DoorWorld) -> None:
    """Also if it begins no handshake."""
    assert world.limits.connections == SLOTS
    for _number in range(100):
        world.network.connect("10.0.0.9", DOOR)
    await asyncio.sleep(1)
    assert len(world.sessions) == SLOTS * 3 // 4
    assert world.refusals[0] == (
        "10.0.0.9 would use 25 connections of this door, leaving 7 for all others;"
        " a host may use at most 3 times as many as it leaves"
    )
    others = [await world.client(f"10.0.1.{number}") for number in (0, 0, 0, 1, 2, 3, 4)]
    assert all(client.is_open for client in others)
    await asyncio.sleep(10)
    assert {session.end for session in world.sessions[:24]} == {"no WebSocket handshake in 10 s"}
    assert all(session.memory.held == 0 for session in world.sessions[:24])


async def test_two_hundred_clients_of_many_hosts_get_the_slots_of_the_door_and_words(
    world: DoorWorld,
) -> None:
    clients = [
        WebSocketClient(*world.network.connect(f"10.0.{n // 100}.{n % 100}", DOOR)) for n in range(200)
    ]
    await asyncio.sleep(6)
    assert sum(client.is_open for client in clients) == SLOTS
    assert set(world.refusals) == {"all hosts together have 32 connections of this door; the limit is 32"}
    statuses = [client.response.status_code for client in clients if client.response is not None]
    assert (statuses.count(101), statuses.count(503)) == (SLOTS, 200 - SLOTS)
    for client in clients:
        client.writer.close()
    await asyncio.sleep(10)
    assert (await world.client()).is_open


async def test_a_host_that_connects_in_a_loop_leaves_new_connections_for_others(world: DoorWorld) -> None:
    admitted = 0
    for _number in range(190):
        client = WebSocketClient(*world.network.connect("10.0.0.9", DOOR))
        await asyncio.sleep(0.01)
        admitted += client.is_open
        client.writer.close()
        await asyncio.sleep(0.01)
    assert admitted == world.limits.in_ten_seconds * 3 // 4
    assert "10.0.0.9 would use 151 new connections of this door in ten seconds" in world.refusals[0]
    assert (await world.client("10.0.0.10")).is_open


async def test_a_host_that_reads_no_refusals_leaves_words_for_others(world: DoorWorld) -> None:
    for number in range(SLOTS):
        await world.client(f"10.0.1.{number}")
    for _number in range(100):
        world.network.connect("10.0.0.9", DOOR)  # and sends no request
    other = await world.client("10.0.0.10")
    assert other.response is not None and other.response.status_code == 503
