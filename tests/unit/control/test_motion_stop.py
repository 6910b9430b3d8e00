import asyncio
from pathlib import Path
from typing import Any

import pytest

from appliance.control.motion_stop import MotionStop, published_before
from appliance.master.graph.graph import Grants
from appliance.master.graph.registry import Kind, Registry
from appliance.master.reconcile.sinks import StoredGraph
from appliance.policy.policy_compiler import compile_policy
from tests.support.core import Core, FakeTrail
from tests.support.incarnations import incarnation

pytestmark = pytest.mark.anyio


async def test_a_new_control_stops_what_was_commanded_once_the_relays_have_its_orders(tmp_path: Path) -> None:
    core, before = Core(tmp_path), Registry()
    commander = incarnation("/a", 4000, host="10.0.0.7")
    own = incarnation("/own", 4001, host="127.0.0.1", own=True)
    for node in (commander, own, incarnation("/b", 4002, host="10.0.0.8")):
        before.add(node)
    for node in (commander, own):
        for topic in ("/cmd_vel", "/other"):
            before.register(node, Kind.PUBLICATION, topic, "geometry_msgs/Twist")
            before.register(node, Kind.SUBSCRIPTION, topic, "geometry_msgs/Twist")
    StoredGraph(Grants(before.mark, set), core.store).flush(before.take_changes())
    lost = published_before(core.store, lambda _host, topic: topic == "/cmd_vel")
    assert lost == {("10.0.0.7", "/cmd_vel")}
    done: list[Any] = []

    async def stop(topic: str) -> list[str]:
        done.append(topic)
        return ["deadman"]

    async def carried_out() -> None:
        done.append("carried out")

    ready = asyncio.Event()
    trail = FakeTrail(lambda record: done.append((record.event, record.host)))
    policy = compile_policy("", file="p.ini")
    stopping = MotionStop(stop, trail, lambda: policy).at_start(lost, ready.is_set, carried_out)
    task = asyncio.ensure_future(stopping)
    await asyncio.sleep(10)
    assert done == []
    ready.set()
    await task
    assert done == ["carried out", "/cmd_vel", ("motion stopped", "10.0.0.7")]
    core.store.close()
