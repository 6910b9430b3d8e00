import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest

from appliance.channel.messages import RankReported
from appliance.channel.messages.relay_link import RankStanding
from appliance.control.motion_stop import MotionStop, published_before
from appliance.features.approvals.control_part import begin as begin_approvals
from appliance.features.authority.control_part import begin as begin_authority
from appliance.master.graph.graph import Grants
from appliance.master.graph.registry import Kind, Registry
from appliance.master.reconcile.sinks import StoredGraph
from appliance.policy.policy_compiler import compile_policy
from tests.support.core import Core, FakeTrail
from tests.support.feature_parts import idle_core
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
    stopping = MotionStop(stop, trail, lambda: policy).at_start(
        lost, ready.is_set, carried_out, lambda _host, _topic: True
    )
    task = asyncio.ensure_future(stopping)
    await asyncio.sleep(10)
    assert done == []
    ready.set()
    await task
    assert done == ["carried out", "/cmd_vel", ("motion stopped", "10.0.0.7")]
    core.store.close()


HOSTS = {"10.0.0.7": "/a", "10.0.0.8": "/b"}
RIGHTS = {
    "held": "[Authority]\nbase = /cmd_vel\ntake base = 10.0.0.7 10.0.0.8\n",
    "ranked": "[Authority]\nbase = /cmd_vel\nrank base = 10.0.0.7 > 10.0.0.8\n",
    "approved": "[Publishers]\n/cmd_vel = ask 10.0.0.7 10.0.0.8\n",
    "granted": "[Publishers]\n/cmd_vel = 10.0.0.7 10.0.0.8\n",
}
STANDINGS: tuple[RankStanding, ...] = ("unknown", "moving", "free", "lost")


@pytest.mark.parametrize("right", RIGHTS)
@pytest.mark.parametrize("standing", STANDINGS)
async def test_a_start_stops_exactly_what_lost_its_right(
    tmp_path: Path, right: str, standing: RankStanding
) -> None:
    """After a start of control alone the relays know the driver of a rank; after one of the appliance, none does."""
    core, before = idle_core(tmp_path), Registry()
    for host, name in HOSTS.items():
        before.add(node := incarnation(name, host=host))
        before.register(node, Kind.PUBLICATION, "/cmd_vel", "geometry_msgs/Twist")
    StoredGraph(Grants(before.mark, set), core.store).flush(before.take_changes())
    core.policy.revisions.policy.set(compile_policy(RIGHTS[right], file="p.ini"))
    stopped: list[str] = []

    async def carried_out(_topics: object = None) -> None:
        core.relay.ranks.reported(RankReported("/cmd_vel", "key of /a", 0, standing))

    async def stop(topic: str) -> list[str]:
        stopped.append(topic)
        return ["deadman"]

    relay = cast(Any, core.relay)
    relay.carried_out, relay.stop, relay.ready = carried_out, stop, lambda: True
    core = replace(core, trail=FakeTrail())
    parts = [await begin(core) for begin in (begin_authority, begin_approvals)]
    for begun in core.policy.first:
        begun()
    for part in parts:
        for what, work in part.work.items():
            if what.startswith("the stop of what was commanded"):
                await work()
    lost = right in {"held", "approved"} or (right == "ranked" and standing == "unknown")
    assert stopped == ["/cmd_vel"] * (len(HOSTS) if lost else 0)
    core.store.close(0)


@pytest.mark.parametrize(
    ("answers", "recorded"),
    [
        ({"/a": ["deadman"], "/b": []}, {"motion stopped": "deadman on /a"}),
        ({"/a": [], "/b": []}, {"motion not stopped": "no enabled guard has a safe message for /a, /b"}),
        ({"/a": None, "/b": ["deadman"]}, {"motion not stopped": "relay of /a", "motion stopped": "on /b"}),
        ({"/a": None, "/b": None}, {"motion not stopped": "the relay of /a, /b does not answer"}),
        ({"/c": None}, {"motion not stopped": "the relay of /c does not answer"}),
        ({"/c": []}, {}),
    ],
)
async def test_the_record_of_a_stop_says_what_is_known(
    answers: dict[str, list[str] | None], recorded: dict[str, str]
) -> None:
    """A relay that does not answer may have a guard."""

    async def stop(topic: str) -> list[str] | None:
        return answers[topic]

    trail = FakeTrail()
    policy = compile_policy("[Authority]\nbase = /a /b\ntake base = 10.0.0.7\n", file="p.ini")
    await MotionStop(stop, trail, lambda: policy).after("10.0.0.7", answers, "why")
    assert trail.events == list(recorded)
    for row in trail.rows:
        assert recorded[row["event"]] in row["reason"]
