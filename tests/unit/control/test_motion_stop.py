import asyncio
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.control.motion_stop import MotionStop, published_before
from appliance.store.state_file import IncarnationRow, RegistrationRow
from tests.support.core import FakeTrail

pytestmark = pytest.mark.anyio


def node(key: str, host: str, *, own: bool = False) -> IncarnationRow:
    return IncarnationRow(key, f"/{key}", host, "http://x:1/", host, 1, 2, own, "live", 0.0)


async def test_a_new_control_stops_what_was_commanded_once_the_relays_have_its_orders() -> None:
    nodes = [node("a", "10.0.0.7"), node("b", "10.0.0.8"), node("own", "127.0.0.1", own=True)]
    rows = [
        RegistrationRow(key, kind, resource, "", 1)
        for key in ("a", "own")
        for kind in ("publication", "subscription")
        for resource in ("/cmd_vel", "/other")
    ]
    store = cast(Any, SimpleNamespace(load_registry=lambda: (nodes, rows)))
    lost = published_before(store, lambda _host, topic: topic == "/cmd_vel")
    assert lost == {("10.0.0.7", "/cmd_vel")}
    done: list[Any] = []

    async def stop(topic: str) -> list[str]:
        done.append(topic)
        return ["deadman"]

    async def carried_out() -> None:
        done.append("carried out")

    relay = SimpleNamespace(ready=lambda: False, carried_out=carried_out)
    trail = FakeTrail(lambda record: done.append((record.event, record.host)))
    work = MotionStop(stop, trail, cast(Any, None)).at_start(lost, cast(Any, relay))
    task = asyncio.ensure_future(work)
    await asyncio.sleep(10)
    assert done == []
    relay.ready = lambda: True
    await task
    assert done == ["carried out", "/cmd_vel", ("motion stopped", "10.0.0.7")]
