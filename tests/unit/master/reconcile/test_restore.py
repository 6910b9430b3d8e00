import errno
import os
from pathlib import Path
from typing import Any

import pytest

from appliance.master.reconcile.sinks import MasterSideApi, ProxyEndpoints, restore_nodes
from appliance.store.state_file import StateStore
from tests.support.control_parts import POLICY, ControlParts
from tests.support.engines import InlineDatabase
from tests.support.memory_ports import face, memory_ports

pytestmark = pytest.mark.anyio
URI = "http://10.0.0.5:4000/"


def busy(_host: str, _port: int) -> Any:
    raise OSError(errno.EADDRINUSE, os.strerror(errno.EADDRINUSE))


def fail(reason: str) -> None:
    raise AssertionError(reason)


def stored(folder: Path) -> StateStore:
    return StateStore(folder, failed=fail, kind=InlineDatabase)


async def store_publisher_of_secret(folder: Path) -> None:
    """An earlier control stores the publisher of /secret."""
    store = stored(folder)
    before = ControlParts(store=store)
    await before.round()
    answer: Any = await before.ask("registerPublisher", "/n", "/secret", "std_msgs/String", URI)
    assert answer[0] == 1
    await before.settle()
    await store.until_settled()
    store.close()


async def restored(world: ControlParts, store: StateStore) -> None:
    await restore_nodes(
        {}, store, world.graph, world.faces, lambda _node: MasterSideApi(world.registry).handle
    )


async def test_restored_nodes_follow_the_policy_in_force(tmp_path: Path) -> None:
    await store_publisher_of_secret(tmp_path)
    store = stored(tmp_path)
    world = ControlParts(store=store)
    await restored(world, store)
    [node] = world.registry.all()
    assert [registration.resource for registration in node.registrations.values()] == ["/secret"]
    assert [world.places.socket(port).getsockname()[1] for port in node.ports] == [*node.ports]
    assert world.reload(POLICY.format("/secret=\n", "")) == 1
    await world.settle()
    assert (list(node.registrations), world.records.pairs) == (
        [],
        [("revoked", "/secret"), ("unregistered", "/secret")],
    )
    store.close()


async def test_a_node_that_finds_no_port_is_recorded_as_lost(tmp_path: Path) -> None:
    await store_publisher_of_secret(tmp_path)
    store = stored(tmp_path)
    world = ControlParts(store=store)
    world.faces = ProxyEndpoints(
        world.registry,
        memory_ports(lambda: world.current, listen=busy),
        9,
        lambda _sock, _handler: face(lambda: None),
    )
    await restored(world, store)
    await world.settle()
    assert world.registry.all() == []
    [record] = world.records.records[:1]
    assert (record.event, record.caller_id) == ("node lost", "/n")
    assert "all ports 19001-26000 are in use" in record.reason
    store.close()
