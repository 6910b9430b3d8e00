import asyncio
import ipaddress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.control.process import _end_others, _restore
from appliance.master.endpoints.node_ports import NodePorts
from appliance.master.graph.graph import Grants
from appliance.master.graph.registry import Incarnation, Kind, Registry
from appliance.master.reconcile.sinks import ProxyEndpoints, StoredGraph
from appliance.store.state_file import StateStore
from roswire.uris import parse_node_uri
from tests.support.engines import InlineDatabase
from tests.support.idle import idle, idle_class

pytestmark = pytest.mark.anyio
URI = "http://10.0.0.5:4000/"


def fail(reason: str) -> None:
    raise AssertionError(reason)


class Ports(idle_class(ProxyEndpoints)):  # type: ignore[misc]  # it is made
    async def reopen(self, _incarnation: Incarnation, _handler: object) -> None:
        """Act as `ProxyEndpoints`."""


async def test_restored_nodes_follow_the_policy_in_force(tmp_path: Path) -> None:
    store = StateStore(tmp_path, failed=fail, kind=InlineDatabase)
    before = Registry()
    host = ipaddress.ip_address("10.0.0.5")
    node = Incarnation("key", "/n", host, parse_node_uri(URI), URI, "10.0.0.1", 19001, 19002)
    before.add(node)
    before.register(node, Kind.PUBLICATION, "/secret", "std_msgs/String")
    StoredGraph(idle(Grants), store).flush(before.take_changes())
    await store.settled()
    registry = Registry()
    decided: list[tuple[object, list[str]]] = []

    def changed(policy: object) -> int:
        decided.append((policy, [resource.resource for _node, resource in registry.in_order()]))
        return 1

    policies = SimpleNamespace(current="the new policy")
    parts = SimpleNamespace(
        core=SimpleNamespace(registry=registry, grants=idle(Grants)),
        serve=lambda _node: None,
        endpoints=SimpleNamespace(
            faces=Ports(),
            places=idle(NodePorts),
            enforcement=SimpleNamespace(policy_changed=changed),
        ),
    )
    base = SimpleNamespace(sockets={}, store=store, policies=policies)
    await _restore(cast(Any, base), cast(Any, parts))
    store.close()
    assert decided == [("the new policy", ["/secret"])]


def test_requests_in_progress_are_stored_before_the_end(tmp_path: Path) -> None:
    store = StateStore(tmp_path, failed=fail, kind=InlineDatabase)

    async def scenario() -> bool:
        under_way = asyncio.Event()

        async def request() -> None:
            try:
                under_way.set()
                await asyncio.Event().wait()
            finally:
                await asyncio.sleep(0)
                store.database.put("setting", "ended", "yes")

        task = asyncio.create_task(request())
        await under_way.wait()
        await _end_others(30)
        return task.done()

    assert asyncio.run(scenario())
    store.close()
    again = StateStore(tmp_path, failed=fail, kind=InlineDatabase)
    assert again.database.query("SELECT value FROM setting WHERE name = 'ended'") == [("yes",)]
    again.close()
