import asyncio
import ipaddress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.control.process import _end_others, _restore
from appliance.master.endpoints.node_ports import NodePorts, NoPortError
from appliance.master.graph.graph import Grants, RosGraph
from appliance.master.graph.registry import Incarnation, Kind, Registry
from appliance.master.reconcile.sinks import StoredGraph
from appliance.store.state_file import StateStore
from roswire.uris import parse_node_uri
from tests.support.core import Core
from tests.support.engines import InlineDatabase
from tests.support.idle import idle

pytestmark = pytest.mark.anyio
URI = "http://10.0.0.5:4000/"


def fail(reason: str) -> None:
    raise AssertionError(reason)


class Restored:
    """Control after a restart with a stored node that published /secret."""

    def __init__(self, folder: Path) -> None:
        self.core = Core(folder)
        before, host = Registry(), ipaddress.ip_address("10.0.0.5")
        node = Incarnation("key", "/n", host, parse_node_uri(URI), URI, "10.0.0.1", 19001, 19002)
        before.add(node)
        before.register(node, Kind.PUBLICATION, "/secret", "std_msgs/String")
        StoredGraph(idle(Grants), self.core.store).flush(before.take_changes())
        self.refusal = ""
        self.decided: list[tuple[object, list[str]]] = []

    async def restore(self) -> None:
        await self.core.store.settled()
        grants = Grants(lambda _row: None, set)
        parts = SimpleNamespace(
            core=SimpleNamespace(
                registry=self.core.registry,
                grants=grants,
                graph=RosGraph(self.core.registry, grants, self.core.trail),
            ),
            serve=lambda _node: None,
            endpoints=SimpleNamespace(
                faces=SimpleNamespace(reopen=self._reopen),
                places=idle(NodePorts),
                enforcement=SimpleNamespace(policy_changed=self._changed),
            ),
        )
        policies = SimpleNamespace(current="the new policy")
        base = SimpleNamespace(sockets={}, store=self.core.store, policies=policies)
        await _restore(cast(Any, base), cast(Any, parts))
        self.core.store.close()

    async def _reopen(self, _node: Incarnation, _handler: object) -> None:
        if self.refusal:
            raise NoPortError(self.refusal)

    @property
    def records(self) -> list[tuple[str, str, str | None]]:
        return [(record.event, record.reason, record.caller_id) for record in self.core.trail.records]

    def _changed(self, policy: object) -> int:
        self.decided.append(
            (policy, [resource.resource for _node, resource in self.core.registry.in_order()])
        )
        return 1


async def test_restored_nodes_follow_the_policy_in_force(tmp_path: Path) -> None:
    control = Restored(tmp_path)
    await control.restore()
    assert (control.decided, control.records) == ([("the new policy", ["/secret"])], [])


async def test_a_node_that_finds_no_port_is_recorded_as_lost(tmp_path: Path) -> None:
    control = Restored(tmp_path)
    control.refusal = "all ports are in use"
    await control.restore()
    assert control.core.registry.all() == []
    assert control.records == [("node lost", "all ports are in use", "/n")]


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
