"""The reconcile loop brings the ROS master to the state of the registry, without revoked registrations."""

import asyncio
from typing import Any, cast

import pytest

from appliance.master.graph.registry import Kind
from appliance.rpc.xmlrpc_client import CallFailedError
from tests.support.control_parts import POLICY, ControlParts

pytestmark = pytest.mark.anyio
NO_SECRET = POLICY.format("/secret=\n", "/secret=\n")


@pytest.mark.parametrize("kind", [Kind.PUBLICATION, Kind.SUBSCRIPTION])
async def test_a_revoked_registration_is_not_adopted(kind: Kind) -> None:
    """A round that runs before the revocation reaches the ROS master removes the registration there."""
    world = ControlParts()
    await world.round()
    node = world.node("/n")
    await world.register(node, kind, "/secret")
    assert world.reload(NO_SECRET) == 1
    await world.round()
    assert (node.resources(kind), list(node.shelf)) == ([], [(kind, "/secret")])
    assert world.hidden.has(kind, "/secret") == []
    await world.settle()
    await world.round()
    assert world.hidden.has(kind, "/secret") == []


async def test_a_parameter_that_was_set_when_control_died_is_sent() -> None:
    """If control died while a parameter was set, the next control sends subscribers the ROS master's current value."""
    world = ControlParts()
    node = world.node("/n")
    for key in ("/speed", "/unset"):
        world.registry.register(node, Kind.PARAMETER, key, "")
    world.hidden.parameters["speed"] = 2
    await world.round()
    assert world.deliveries.told == [
        ("/n", "paramUpdate", ("/speed/", 2)),
        ("/n", "paramUpdate", ("/unset/", {})),
    ]


async def test_a_new_master_is_complete_before_the_first_call() -> None:
    """A returning node does not make a new ROS master available; only the complete rebuild does."""
    world = ControlParts(silent=3600.0)
    await world.round()
    node, other = world.node("/n", 1), world.node("/other", 2)
    await world.register(node, Kind.PUBLICATION, "/t")
    await world.register(other, Kind.PUBLICATION, "/u")
    world.rosmaster.shut()
    world.hidden.restart()
    with pytest.raises(CallFailedError):
        await world.entries.put_back(node, list(node.registrations.values()))
    assert (world.rosmaster.reachable, world.rosmaster.doubtful.is_set()) == (False, True)
    await world.round()
    assert (world.rosmaster.reachable, world.entries.pid) == (True, world.hidden.pid)
    assert [world.hidden.has(Kind.PUBLICATION, topic) for topic in ("/t", "/u")] == [["/n"], ["/other"]]


class _Patient:
    """A ROS master that answers `method` only when `many` of these calls are waiting."""

    def __init__(self, world: ControlParts, method: str, many: int) -> None:
        self._hidden, self._method, self._many = world.hidden, method, many
        self.told: list[Any] = []
        self._all = asyncio.Event()
        world.rosmaster.calls = cast(Any, self)

    async def call(self, method: str, *params: Any) -> Any:
        """Answer one call."""
        if method == self._method:
            self.told.append(params[1])
            if len(self.told) == self._many:
                self._all.set()
            await self._all.wait()
        return await self._hidden.call(method, *params)


async def test_a_new_master_is_rebuilt_without_waiting_for_each_answer() -> None:
    """All callers wait during the rebuild, so thousands of registrations must not take thousands of round trips."""
    world = ControlParts()
    await world.round()
    node = world.node("/n")
    names = [f"/t{number}" for number in range(40)]
    for name in reversed(names):
        await world.register(node, Kind.PUBLICATION, name)
    world.hidden.restart()
    master = _Patient(world, "registerPublisher", len(names))
    async with asyncio.timeout(60):
        await world.round()
    assert master.told == names[::-1]


async def test_a_lost_node_is_removed_without_waiting_for_each_answer() -> None:
    """Thousands of registrations without an owner are removed without a round trip each."""
    world = ControlParts()
    await world.round()
    gone = world.faces.inner_uri(world.node("/n"))
    for number in range(40):
        await world.hidden.call("registerPublisher", "/gone", f"/t{number}", "t", gone)
    _Patient(world, "unregisterPublisher", 40)
    async with asyncio.timeout(60):
        await world.round()
    assert not any(world.hidden.tables[Kind.PUBLICATION].values())


async def test_a_returning_node_is_restored_without_waiting_for_each_answer() -> None:
    """The returning node's registrations are restored in their original order, without a round trip each."""
    world = ControlParts(silent=3600.0)
    await world.round()
    node = world.node("/n")
    names = [f"/t{number}" for number in range(40)]
    for name in names:
        await world.register(node, Kind.PUBLICATION, name)
    master = _Patient(world, "registerPublisher", len(names))
    async with asyncio.timeout(60):
        await world.entries.put_back(node, node.in_order())
    assert master.told == names


async def test_a_round_does_not_show_as_a_rebuild() -> None:
    """Calls wait during a round, but the status shows a rebuild only if there is one."""
    world = ControlParts()
    seen: list[tuple[str, bool, bool]] = []
    call = world.hidden.call

    async def watched(method: str, *params: Any) -> Any:
        seen.append((method, world.rosmaster.reachable, world.rosmaster.whole))
        return await call(method, *params)

    world.hidden.call = watched  # type: ignore[method-assign]  # the same ROS master, observed
    assert not world.rosmaster.whole
    await world.round()
    await world.register(world.node("/n"), Kind.PUBLICATION, "/t")
    seen.clear()
    await world.round()
    assert {(reachable, whole) for _, reachable, whole in seen} == {(False, True)}
    world.hidden.restart()
    seen.clear()
    await world.round()
    assert {whole for method, _, whole in seen if method != "getPid"} == {False}
    assert (world.rosmaster.reachable, world.rosmaster.whole) == (True, True)
