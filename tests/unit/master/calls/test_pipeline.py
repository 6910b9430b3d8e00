import asyncio
import copy
import ipaddress
import random
import threading
from collections.abc import Callable
from functools import partial
from typing import Any, cast

import pytest

from appliance.master.calls import pipeline
from appliance.master.calls.call_execution import Execution
from appliance.master.calls.call_table import master_table
from appliance.master.calls.gate import CallGate, HostLimits
from appliance.master.calls.lookups import LookupCalls
from appliance.master.calls.monitor_calls import MonitorCalls
from appliance.master.calls.multicall import Multicall
from appliance.master.calls.parameter_calls import ParameterCalls, ParameterRights
from appliance.master.calls.pipeline import Pipeline
from appliance.master.calls.registration import RegistrationCalls
from appliance.master.endpoints.node_ports import AdvertisedAddresses
from appliance.master.graph.graph import RosGraph
from appliance.master.graph.registry import Kind, Registry
from appliance.master.reconcile.subscribers import Subscribers
from appliance.master.rosmaster import RosMaster
from appliance.policy.model import Decision
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.rpc.fair_queue import LargeWrites, bulk_turns
from appliance.rpc.processor_time import ProcessorTime
from appliance.rpc.server import HttpRequest, Peer
from appliance.rpc.xmlrpc_client import CallFailedError
from roswire.xmlrpc import Value, XmlRpcLimits, build_call, parse_response
from tests.support.control_parts import Records
from tests.support.examples import examples
from tests.support.idle import idle
from tests.support.incarnations import incarnation
from tests.support.parameters import mirror, put, registered

pytestmark = [pytest.mark.anyio, pytest.mark.timeout(20)]

HOST = ipaddress.ip_address("10.0.0.9")

ADMIN, OPERATOR = "10.0.0.9", "10.0.0.5"
THIRD = "10.0.0.7"
OFFLOAD = 256 << 10
POLICY = """
[Groups]
ocu = 10.0.0.5
adm = 10.0.0.9
[Nodes]
default = *
[Commands]
default = *
[Parameters]
"""
LIMITED = """
read default   = *
write default  = adm
write /arm/**  = adm ocu
write /arm/max = adm
"""


class Trail(Records):
    def __init__(self) -> None:
        super().__init__()
        self.decisions: list[tuple[str, str, Decision]] = []

    def decided(
        self, asker: Any, method: str, category: str, resource: str, decision: Decision, **more: Any
    ) -> str:
        self.decisions.append((method, more.get("key", resource), decision))
        return "id"


class Site:
    def __init__(self, rules: str = LIMITED, tree: Any = None, *, bytes_limit: int = 64 << 20) -> None:
        self.policy_text = POLICY + rules
        self.policy = compile_policy(self.policy_text, file="test.ini")
        self.trail = Trail()
        self.registry = Registry()
        self.parameters = mirror(copy.deepcopy(tree or {}), whole=bytes_limit)
        self.there = mirror(copy.deepcopy(tree or {}))
        self.arrived: list[str] = []
        self.go = asyncio.Event()
        self.go.set()
        self.faults: set[str] = set()  # keys that the ROS master answers with a fault
        self.dies_at = ""  # the key whose request kills the ROS master
        self.serve = self._pipeline().handler(self.table)

    def _pipeline(self) -> Pipeline:
        def policy() -> Policy:
            return self.policy

        registry, graph = self.registry, idle(RosGraph)
        nothing: Any = None
        rights = ParameterRights(policy, self.trail)
        calls = ParameterCalls(
            cast(RosMaster, self), self.parameters, idle(Subscribers).parameter_set, rights, OFFLOAD
        )
        self.table = master_table(
            RegistrationCalls(registry, graph, nothing, nothing, calls, idle(Subscribers)),
            LookupCalls(registry, graph, nothing, nothing, port=11311, stop=lambda _reason: None),
            calls,
            MonitorCalls(nothing, registry, nothing, real_port=11312, port=11311),
        )
        execution = Execution(
            gate=CallGate(policy, registry, HostLimits()),
            policy=policy,
            trail=self.trail,
            registry=registry,
            flush=lambda: None,
            liveness=nothing,
            parameters=calls,
            redecide_for=nothing,
            hold_call=nothing,
            large=OFFLOAD,
            large_writes=LargeWrites(OFFLOAD, registered),
        )
        return Pipeline(
            execution,
            Multicall(execution, calls, self.trail, offload=OFFLOAD),
            addresses=cast(AdvertisedAddresses, self),
            trail=self.trail,
            limits=XmlRpcLimits(),
            offload=OFFLOAD,
            bulk=bulk_turns(registered),
            processor=ProcessorTime(lambda host: host),
        )

    async def learn(self, _peer: Peer) -> None: ...

    @property
    def reachable(self) -> bool:
        return False

    async def wait(self) -> bool:
        return False

    async def call(self, method: str, *params: Any) -> Any:
        return (await self.call_in_order([(method, params)]))[0]

    async def call_in_order(self, calls: Any) -> list[Any]:
        self.arrived += [f"{method} {params[1]}" for method, params in calls]
        await self.go.wait()
        if self.dies_at in [params[1] for _method, params in calls]:
            raise CallFailedError("the ROS master did not come back")
        return [
            CallFailedError("a fault") if params[1] in self.faults else self._done(method, *params[1:])
            for method, params in calls
        ]

    def _done(self, method: str, key: str, *value: Any) -> Any:
        if method == "setParam":
            put(self.there, key, copy.deepcopy(value[0]), HOST)
            return [1, "set", 0]
        if method == "deleteParam":
            self.there.delete(key)
            return [1, "deleted", 0]
        node: Any = self.there.tree
        for part in key.split("/"):
            node = node.get(part) if part and isinstance(node, dict) else node
        if method == "hasParam":
            return [1, key, node is not None]
        return [-1, "not there", 0] if node is None else [1, "there", copy.deepcopy(node)]

    async def ask(self, host: str, method: str, *params: Value) -> Any:
        peer = Peer(ipaddress.ip_address(host), host, "10.0.0.1")
        return parse_response(await self.serve(HttpRequest(peer, "/", build_call(method, params), 0)))


@pytest.fixture
def site() -> Site:
    return Site()


def part(method: str, *params: Value) -> Value:
    return {"methodName": method, "params": ["/me", *params]}


async def others() -> None:
    for _ in range(20):
        await asyncio.sleep(0)


def sets(*keys: str) -> list[Value]:
    return [part("setParam", key, 1) for key in keys]


RUNS = [[f"/arm/{run}_{place}" for place in range(64)] for run in range(3)]


def told(answers: list[Any]) -> list[int]:
    return [answer[0][0] for answer in answers]


async def held(site: Site, parts: list[Value]) -> "asyncio.Task[Any]":
    site.go.clear()
    asked = asyncio.create_task(site.ask(OPERATOR, "system.multicall", parts))
    await others()
    return asked


@pytest.mark.nightly
async def test_a_long_multicall_yields_after_a_few_parts(site: Site) -> None:
    reads: list[Value] = [part("hasParam", f"/arm/{number}") for number in range(9000)]
    asked = asyncio.create_task(site.ask(OPERATOR, "system.multicall", reads))
    most = before = 0
    while not asked.done():
        await asyncio.sleep(0)
        most, before = max(most, len(site.trail.decisions) - before), len(site.trail.decisions)
    assert told(await asked) == [1] * 9000
    assert most <= 16


@pytest.mark.parametrize(
    "following",
    [
        part("setParam", "/arm/elsewhere", 1),
        part("setParam", "/arm/0_7/below", 1),
        part("deleteParam", "/arm"),
        part("hasParam", "/leg"),
        part("searchParam", "/leg"),
    ],
    ids=["a write elsewhere", "a write below", "a write above", "a read", "another call"],
)
async def test_calls_after_a_run_wait_for_it(following: Value, site: Site) -> None:
    asked = await held(site, [*sets(*RUNS[0]), following, *sets(*RUNS[1])])
    assert len(site.trail.decisions) == len(RUNS[0])
    site.go.set()
    assert len(await asked) == 2 * len(RUNS[0]) + 1
    assert site.there.tree == site.parameters.tree


async def test_writes_after_a_waiting_read_are_decided_again() -> None:
    async def scene(change: Callable[[Site], None], *, denied: bool = True) -> None:
        site, keys = Site(), RUNS[0][:7]
        asked = await held(site, [part("hasParam", "/leg"), *sets(*keys)])
        assert [one.allowed for _, _, one in site.trail.decisions] == [True] * 8
        change(site)
        site.go.set()
        assert told(await asked) == [1] + [int(not denied)] * 7
        assert site.arrived == ["hasParam /leg", *([] if denied else [f"setParam {key}" for key in keys])]
        assert [one.allowed for _, _, one in site.trail.decisions[8:]] == [False] * (7 if denied else 0)

    def registers(site: Site, host: str) -> None:
        node = incarnation("/me", 5000, host=host)
        site.registry.add(node)
        site.registry.register(node, Kind.PUBLICATION, "/chatter", "std_msgs/String")

    stricter = compile_policy(f"{POLICY}write default = adm\n", file="test.ini")
    await scene(partial(registers, host=THIRD))
    await scene(partial(registers, host=OPERATOR), denied=False)
    await scene(lambda site: setattr(site, "policy", stricter))
    await scene(lambda site: setattr(site.trail.log, "failure", "the log is full"))


async def test_a_failure_in_a_run_stops_no_other_part(site: Site) -> None:
    site.faults, site.dies_at = {RUNS[0][5]}, RUNS[1][30]
    keys = [*RUNS[0][:63], "/leg", *RUNS[1][:62], "bad key!?", "/leg", *RUNS[2]]
    answers = told(await site.ask(OPERATOR, "system.multicall", sets(*keys)))
    assert answers == [1] * 5 + [0] + [1] * 57 + [0] + [0] * 62 + [-1, 0] + [1] * 64
    assert site.there.tree == {"arm": {key[5:]: 1 for key in RUNS[0][:63] + RUNS[2] if key != RUNS[0][5]}}
    assert site.there.tree == site.parameters.tree
    again = await site.ask(OPERATOR, "system.multicall", sets(*RUNS[0], *RUNS[2]))  # no turn is left locked
    assert told(again).count(1) == 127


@pytest.mark.timeout(300)
async def test_a_multicall_equals_its_parts_one_by_one() -> None:
    async def scene(dice: random.Random) -> None:
        keys = ["/arm", "/arm/a", "/arm/a/b", "/arm/max", "/leg", "/leg/x", *RUNS[0]]
        likely = [1] * 6 + [2] * len(RUNS[0])
        parts: list[Any] = []
        for key in dice.choices(keys, likely, k=400):
            calls: list[Any] = [
                ("setParam", key, dice.choice([1, {"b": 1}, {"max": 2}])),
                ("deleteParam", key),
                ("hasParam", key),
            ]
            method, *params = dice.choices(calls, [40, 8, 1])[0]
            parts.append(part(method, *params))
        together, alone = Site(tree={"arm": {"max": 5}}), Site(tree={"arm": {"max": 5}})
        answers = await together.ask(OPERATOR, "system.multicall", parts)
        assert answers == [[await alone.ask(OPERATOR, one["methodName"], *one["params"])] for one in parts]
        assert together.trail.decisions == alone.trail.decisions
        assert together.there.tree == together.parameters.tree == alone.there.tree

    for seed in range(examples(24)):
        await asyncio.wait_for(scene(random.Random(seed)), 20)  # noqa: S311  the same calls in every run


async def test_a_namespace_that_appears_after_the_decision_is_hidden() -> None:
    site = Site("read /arm = ocu adm\nread default = adm\nwrite default = adm\n")
    put(site.there, "/arm", {"speed": 4711}, HOST)  # and the mirror does not have it yet
    answer = await site.ask(OPERATOR, "getParam", "/me", "/arm")
    assert answer[0] == 0
    assert "4711" not in str(answer)
    assert answer[1].endswith("[id]")
    assert site.trail.decisions[-1][1:2] == ("/arm",)
    assert (await site.ask(ADMIN, "getParam", "/admin", "/arm"))[2] == {"speed": 4711}


@pytest.mark.nightly
async def test_the_answers_of_a_multicall_are_bounded_together() -> None:
    site = Site(tree={"arm": {"model": "x" * 100_000, "speed": 1}}, bytes_limit=1_000_000)
    wanted: list[Value] = [part("getParam", "/arm/model")] * 100
    answers = await site.ask(OPERATOR, "system.multicall", wanted)
    assert len(answers) == 100
    assert [answer[0][0] for answer in answers[:10]] == [1] * 10
    assert all("more than 1000000 bytes; 90 more parts" in answer["faultString"] for answer in answers[10:])
    assert len(site.arrived) == 10
    assert site.trail.events == ["limit exceeded"]
    usual = await site.ask(OPERATOR, "system.multicall", [part("getParam", "/arm/speed")] * 100)
    assert [one[0][0] for one in usual] == [1] * 100


@pytest.mark.nightly
@pytest.mark.parametrize("together", [False, True], ids=["alone", "in a multicall"])
async def test_large_answers_are_made_a_few_at_a_time(together: bool) -> None:
    site = Site(tree={"arm": {"model": "x" * OFFLOAD}, "leg": 1})

    async def dump(host: str) -> None:
        if together:
            [answer] = await site.ask(host, "system.multicall", [part("getParam", "/arm")])
        else:
            answer = [await site.ask(host, "getParam", "/me", "arm/")]
        assert answer[0][0] == 1

    site.go.clear()
    dumps = [asyncio.create_task(dump(host)) for host in [OPERATOR] * 5 + [ADMIN, THIRD]]
    small = asyncio.create_task(site.ask(OPERATOR, "getParam", "/me", "/leg"))
    await others()
    assert site.arrived == ["getParam /arm", "getParam /arm", "getParam /leg"]
    site.go.set()
    assert (await small)[2] == 1
    await asyncio.gather(*dumps)
    assert site.arrived.count("getParam /arm") == 7


@pytest.mark.nightly
async def test_large_bodies_and_answers_are_not_read_and_written_on_the_loop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    threads: list[tuple[str, bool]] = []

    def observed(name: str) -> None:
        real = getattr(pipeline, name)

        def observe(*arguments: Any) -> Any:
            threads.append((name, threading.current_thread() is threading.main_thread()))
            return real(*arguments)

        monkeypatch.setattr(pipeline, name, observe)

    observed("parse_call")
    observed("build_response")
    site = Site(tree={"arm": {"gains": list(range(20_000))}})
    await site.ask(OPERATOR, "getParam", "/me", "/arm")
    assert threads == [("parse_call", True), ("build_response", False)]
    threads.clear()
    await site.ask(OPERATOR, "setParam", "/me", "/arm/model", "x" * OFFLOAD)
    assert threads == [("parse_call", False), ("build_response", True)]
