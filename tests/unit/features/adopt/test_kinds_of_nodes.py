"""Each kind of node, in each end of an adoption: it hears every living publisher, and no registration is lost.

Bonds, nodelets, actions and recordings, which only real nodes show, are in `test_adopt_nodes.py` and
`test_adopt_kills.py` of `tests/system/network`.
"""

import itertools
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from appliance.features.adopt.adopt_record import Phase
from tests.support.engines import KilledError
from tests.support.examples import covering
from tests.unit.features.adopt.robot_world import LINK, RobotNode, RobotWorld
from tests.unit.features.adopt.test_takeover import GIVE, TAKE

pytestmark = pytest.mark.anyio
Act = Callable[[RobotWorld], Awaitable[None]]
NUC = "192.168.50.2"


async def start(world: RobotWorld, name: str, port: int, host: str = "base", **roles: Any) -> None:
    """Start a node that finds RVMaster."""
    node = world.robot[name] = RobotNode(name, f"http://{host}:{port}/", port, **roles)
    address = LINK if host == "base" else NUC
    for topic in node.publishes:
        await world.parts.ask("registerPublisher", name, topic, "std_msgs/String", node.uri, host=address)
    for topic in node.subscribes:
        answer: Any = await world.parts.ask(
            "registerSubscriber", name, topic, "std_msgs/String", node.uri, host=address
        )
        world.give_list(node, topic, list(answer[2]))


async def end(world: RobotWorld, name: str) -> None:
    """End a node without its own doing."""
    world.robot[name].alive = False


# --- what happens to nodes while the graph is adopted ---


async def stays(_world: RobotWorld) -> None: ...


async def new_publisher(world: RobotWorld) -> None:
    await start(world, "/new", 4020, publishes=("/cmd_vel",))


async def new_subscriber(world: RobotWorld) -> None:
    await start(world, "/new", 4020, subscribes=("/odom", "/cmd_vel"))


async def restarted_publisher(world: RobotWorld) -> None:
    await end(world, "/teleop")
    await start(world, "/teleop", 4022, publishes=("/cmd_vel",), subscribes=("/odom",))


async def dead_publisher(world: RobotWorld) -> None:
    await end(world, "/teleop")


async def dead_subscriber(world: RobotWorld) -> None:
    await end(world, "/rviz")


async def hanging_subscriber(world: RobotWorld) -> None:
    world.robot["/rviz"].hangs = True


async def hanging_publisher(world: RobotWorld) -> None:
    world.robot["/teleop"].hangs = True


async def dead_in_the_middle(world: RobotWorld) -> None:
    for step in ("give", "cut"):
        world.after[step] = lambda: setattr(world.robot["/rviz"], "alive", False)


async def second_computer_ends(world: RobotWorld) -> None:
    for name in ("/far", "/far_ears"):
        await end(world, name)


async def second_computer_reboots(world: RobotWorld) -> None:
    await second_computer_ends(world)
    await start(world, "/far", 4030, "nuc", publishes=("/scan",), subscribes=("/odom",))
    await start(world, "/far_ears", 4031, "nuc", subscribes=("/scan", "/cmd_vel"))


async def second_computer_reboots_with_its_ports(world: RobotWorld) -> None:
    """Its nodes get the same ports again, so the same URIs: a life of a node that the appliance cannot tell apart."""
    for name in ("/far", "/far_ears"):
        world.robot[name].links.clear()
    await start(world, "/far", 4010, "nuc", publishes=("/scan",), subscribes=("/odom",))
    await start(world, "/far_ears", 4011, "nuc", subscribes=("/scan", "/cmd_vel"))


async def second_computer_boots_later(world: RobotWorld) -> None:
    await start(world, "/later", 4040, "nuc", publishes=("/scan", "/cmd_vel"), subscribes=("/odom", "/scan"))


KINDS: tuple[Act, ...] = (
    hanging_subscriber, stays, new_publisher, new_subscriber, restarted_publisher, dead_publisher, dead_subscriber,
    hanging_publisher, dead_in_the_middle, second_computer_ends, second_computer_reboots,
    second_computer_reboots_with_its_ports, second_computer_boots_later,
)  # fmt: skip


# --- how the adoption goes on ---


async def released(world: RobotWorld) -> None:
    await world.release()


async def restarted(world: RobotWorld) -> None:
    """The appliance ends in order and starts again."""
    await world.operation.give()
    world.begin()
    await world.until_settled()


def killed(step: str, goes_on: Act) -> Act:
    """Control is killed after a step of what goes on."""

    async def act(world: RobotWorld) -> None:
        world.killed_after = step
        try:
            await goes_on(world)
        except KilledError:
            world.begin()
            await world.until_settled()

    act.__name__ = f"killed_after_{step.replace(' ', '_')}_{goes_on.__name__}"
    return act


async def started_again(world: RobotWorld) -> None:
    """Control was killed while nothing was under way."""
    world.begin()
    await world.until_settled()


ENDS: tuple[Act, ...] = (
    restarted,
    released,
    started_again,
    *(killed(step, released) for step in GIVE),
    *(killed(step, restarted) for step in (*GIVE, *TAKE)),
)


def named(acts: tuple[Act, ...]) -> dict[str, Act]:
    return {act.__name__.replace("_", " "): act for act in acts}


KIND_OF, END_OF = named(KINDS), named(ENDS)


@pytest.mark.parametrize(("kind", "goes_on"), [*covering(itertools.product(KIND_OF, END_OF))])
async def test_each_living_node_hears_and_no_registration_is_lost(
    bare: RobotWorld, kind: str, goes_on: str
) -> None:
    bare.resolved["nuc"] = [NUC]
    bare.add("/base", 4001, publishes=("/odom",), subscribes=("/cmd_vel",), services=("/reset",))
    bare.add("/teleop", 4002, publishes=("/cmd_vel",), subscribes=("/odom",))
    bare.add("/rviz", 4003, subscribes=("/odom", "/cmd_vel"))
    bare.add("/far", 4010, "http://nuc:4010/", publishes=("/scan",), subscribes=("/odom",))
    bare.add("/far_ears", 4011, "http://nuc:4011/", subscribes=("/scan", "/cmd_vel"))
    await bare.until_settled()
    await KIND_OF[kind](bare)
    await bare.parts.settle()
    await END_OF[goes_on](bare)
    wakes_up(bare)
    await bare.operation.settle(await bare.operation.facts(), settled=True)  # as control does each minute
    await bare.parts.settle()
    bare.hear()
    bare.connect_all()
    require_hearing(bare)


def wakes_up(world: RobotWorld) -> None:
    for node in world.robot.values():
        if node.hangs:
            node.hangs = False
            for topic, uris in node.held:
                world.give_list(node, topic, uris)


def require_hearing(world: RobotWorld) -> None:
    alive = [node for node in world.robot.values() if node.alive]
    taken = world.record.phase is Phase.TAKEN
    held = world.adopted() if taken else world.master.entries
    for node in alive:
        assert node.entries() <= held, f"{node.name} is not registered"
    for node, other in itertools.product(alive, alive):
        for topic in {*node.subscribes} & {*other.publishes} if node is not other else ():
            publisher = world.graph.registry.holder(other.name)
            assert publisher is not None or not taken
            uri = publisher.outer_uri("10.0.0.1") if publisher is not None and taken else other.uri
            assert node.links[topic].get(uri), f"{node.name} does not hear {other.name} on {topic}"
