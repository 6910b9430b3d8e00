"""Answer the requests for a guard's proof test: the fault on a copy, the way of its stop to the driver, and the record.

1. Nothing is sent before the robot is known to stand: for `WATCH_SECONDS` no motion was commanded, and a zero was, or
   the odometry of the base was zero. Silence alone proves nothing.
2. One stop is sent, on the appliance's own connections, and never a motion.
3. The last test of each guard is kept over restarts, with the digest of the guard that was tested.
"""

import asyncio
import math
from collections.abc import Iterator, Mapping
from contextlib import suppress

import msgspec

from appliance.base import clock
from appliance.base.withdrawal import take_effect
from appliance.channel.messages import GuardTested, GuardTestWanted, MessageSeen
from appliance.control.core import GraphFacts, RelayOrders
from appliance.control.errors import SenselessError, UnavailableError
from appliance.control.operators.request_method import RequestMethod
from appliance.features.guards.guard_answers import GuardRow, ProofTest, StopReached
from appliance.features.guards.guard_facts import facts_of, values_of
from appliance.features.guards.guard_orders import GuardOrders
from appliance.features.guards.presets import GuardError, topics_in, types_in
from appliance.features.guards.requests import GuardTest
from appliance.features.guards.robot_graph import RobotGraph
from appliance.features.guards.stimuli import VELOCITIES, stimulus
from appliance.specifications.specification_manager import SpecificationManager
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import AuditTrail

WATCH_SECONDS = 3.0
_STANDING = 0.01  # m/s and rad/s, as in `cli/robot_motions.py`
_MESSAGES = 20  # of a look
_MAX_ODOMETRY = 4
_SETTING = "guard tests"
_ODOMETRY = "nav_msgs/Odometry"
_WITHOUT_ROLE = {"stop": "std_msgs/Bool", "reset": "std_msgs/Bool", "check": "std_msgs/Bool", "mute": "std_msgs/Bool",
                 "fix": "sensor_msgs/NavSatFix"}  # fmt: skip
_NO_MOTION = (
    "header",
    "child_frame_id",
    "pose",
    "covariance",
    "acceleration",
    "jerk",
    "steering_angle",
    "steering_angle_velocity",
)
"""The fields of velocities and odometry that are zero or not while a base stands."""


def kept_tests(store: StateStore) -> dict[str, ProofTest]:
    """Return the last test of each guard, by its name; an unreadable row counts as none."""
    with suppress(ValueError):
        return msgspec.json.decode(store.settings().get(_SETTING, "{}"), type=dict[str, ProofTest])
    return {}


class ProofTests:
    """Tests one guard at a time; `kept` are the last tests."""

    def __init__(
        self,
        monitors: SpecificationManager,
        guards: GuardOrders,
        kept: dict[str, ProofTest],
        *,
        graph: GraphFacts,
        relay: RelayOrders,
        trail: AuditTrail,
        store: StateStore,
    ) -> None:
        self._monitors, self._guards, self._kept = monitors, guards, kept
        self._graph, self._relay, self._trail, self._store = graph, relay, trail, store
        self._testing = asyncio.Lock()

    def methods(self) -> tuple[RequestMethod[object], ...]:
        return (RequestMethod(GuardTest, self.test, who=True),)

    async def test(self, request: GuardTest, who: str) -> ProofTest:
        """Raises `UnknownThingError`, and `SenselessError` if the robot is not known to stand."""
        if self._testing.locked():
            raise SenselessError("another guard is being tested: try again in a few seconds")
        async with self._testing:
            return await self._test(self._guards.row(request.name), who)

    async def _test(self, row: GuardRow, who: str) -> ProofTest:
        text = self._monitors.sources.files[row.file]
        if row.state in ("off", "shadow", "holding", "broken"):
            raise SenselessError(f"{row.name} is not in force ({row.state}): only guards in force are tested")
        topics, types = topics_in(text) | row.topics, _WITHOUT_ROLE | types_in(text)
        try:
            made = stimulus(row.preset, topics, types, values_of(row.given) | row.loads)
        except GuardError as error:
            raise SenselessError(str(error)) from error
        command = topics["command"]
        why_not = await self._why_not_sent(row.preset, command, types["command"], who)
        wanted = GuardTestWanted(0, row.name, command, made.messages, made.fault, deliver=not why_not)
        take_effect()  # the robot was watched for seconds
        found = await self._relay.test(wanted)
        if found is None or found.why:
            raise UnavailableError(
                f"{row.name} was not tested: {found.why if found else 'its relay does not answer'}"
            )
        act = found.act or "passed"
        test = ProofTest(
            clock.wall(), row.digest, made.what, act if found.passed else "undecided",
            found.cause if found.passed else "", found.after, found.seconds,
            [*self._reached(found, command)], why_not, who,
        )  # fmt: skip
        self._keep(row.name, test, command)
        return test

    async def _why_not_sent(self, preset: str, command: str, kind: str, who: str) -> str:
        """Return why the stop is not sent, or an empty text. Raises `SenselessError` while the robot moves."""
        if preset == "withhold":
            return "this guard sends no stop"
        facts = facts_of(self._graph.present())
        topic = next((fact for fact in facts if fact.name == command), None)
        if topic is None:
            raise SenselessError(f"no node publishes or subscribes to {command}: there is no driver to reach")
        robots = RobotGraph(facts, [command])
        sources = robots.sources(topic, (_ODOMETRY,)) if kind in VELOCITIES else []
        odometry = [source.name for source in sources][:_MAX_ODOMETRY]
        watched = [command, *odometry]
        seen = dict(
            zip(watched, await asyncio.gather(*(self._watch(one, who) for one in watched)), strict=True)
        )
        if kind not in VELOCITIES:
            if seen[command]:
                raise SenselessError(
                    f"a node, {self._sender(seen[command])}, uses {command}: test it when no node does"
                )
            return f"no topic says that what {kind} moves stands still"
        for name, messages in seen.items():
            moving = next((message for message in messages if not _speed(message.fields) <= _STANDING), None)
            if moving is not None and name == command:
                raise SenselessError(
                    f"{self._sender([moving])} drives on {command}: test it when the robot stands still"
                )
            if moving is not None:
                raise SenselessError(f"{name} says that the base moves: test it when the robot stands still")
        if not seen[command] and not any(seen[name] for name in odometry):
            raise SenselessError(
                f"the robot is not known to stand still: within {WATCH_SECONDS:g} s no zero was commanded on {command},"
                f" and {f'{odometry[0]} was silent' if odometry else 'no odometry is published'}: let a node command"
                " zero, and test again"
            )
        return ""

    async def _watch(self, topic: str, who: str) -> list[MessageSeen]:
        seen, until = list[MessageSeen](), clock.now() + WATCH_SECONDS
        while (left := until - clock.now()) > 0:
            found = await self._relay.look(topic, _MESSAGES, left, who, latched=False)
            if not found:  # all the time is over, or its relay is away
                break
            seen += found
        return seen

    def _sender(self, messages: list[MessageSeen]) -> str:
        return self._graph.name_of(messages[0].key) or "a node"

    def _reached(self, found: GuardTested, command: str) -> Iterator[StopReached]:
        graph = self._graph.present()
        facts = facts_of(graph)
        drivers = {
            node for fact in facts if fact.name == command for node in RobotGraph(facts, [command]).ends(fact)
        }
        for one in found.reached:
            yield StopReached(one.node, one.host, one.node in drivers, one.accepted, one.acknowledged)
        hosts = {node.name: node.host for node in graph.nodes}
        for node in sorted(drivers - {one.node for one in found.reached}) if found.reached else ():
            yield StopReached(node, hosts.get(node, ""), driver=True, accepted=None, acknowledged=None)

    def _keep(self, name: str, test: ProofTest, command: str) -> None:
        self._trail.happened(
            "guard tested",
            f"{name}: {test.in_words()}",
            category="monitor",
            resource=command,
            who=test.who,
            monitor=name,
            **{each: value for each, value in msgspec.to_builtins(test).items() if each not in ("at", "who")},
        )
        loaded = self._monitors.checked.monitors
        for gone in [each for each in self._kept if each not in loaded]:
            del self._kept[gone]
        self._kept[name] = test
        with suppress(StoreError):  # a full disk has its own alarm; the record is in the audit log
            self._store.save_setting(_SETTING, msgspec.json.encode(self._kept).decode())


def _speed(fields: object) -> float:
    """Return the largest velocity in a message; infinity if it cannot be read."""
    values = [*_velocities(fields)]
    return max(values, default=math.inf)


def _velocities(fields: object) -> Iterator[float]:
    if isinstance(fields, Mapping):
        for name, value in fields.items():
            if name not in _NO_MOTION:
                yield from _velocities(value)
    elif isinstance(fields, int | float):
        yield math.inf if math.isnan(fields) else abs(fields)
    else:
        yield math.inf
