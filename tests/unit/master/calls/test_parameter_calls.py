"""After every step, the mirror of the parameters equals the tree that rosmaster's own code makes."""

import asyncio
import copy
import ipaddress
import json
import subprocess
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from appliance.master.calls.call import Caller
from appliance.master.calls.parameter_calls import ParameterCalls, ParameterRights, ParameterWrite
from appliance.master.parameter_charges import LimitReachedError, measure
from appliance.master.parameter_mirror import ParameterMirror
from appliance.master.rosmaster import RosMaster
from appliance.policy.policy_compiler import compile_policy
from appliance.rpc.server import Peer
from appliance.rpc.xmlrpc_client import CallFailedError
from roswire.errors import EncodingError, ProtocolError
from roswire.xmlrpc import Value, XmlRpcLimits
from tests.support import autojump
from tests.support.control_parts import OPEN, ControlParts
from tests.support.core import FakeTrail
from tests.support.examples import examples
from tests.support.nodes import PYTHON, answering
from tests.support.parameters import mirror, put

pytestmark = pytest.mark.anyio

HOST = ipaddress.ip_address("10.0.0.1")
ORACLE = """
import json, sys
from rosmaster.paramserver import ParamDictionary
for line in sys.stdin:
    tree = ParamDictionary(None)
    for do, key, value in json.loads(line):
        try:
            tree.set_param(key, value) if do == "set" else tree.delete_param(key)
        except (KeyError, TypeError):
            pass
    print(json.dumps(tree.parameters), flush=True)
"""
WHOLE = """
import json, sys
from rosmaster.master_api import ROSMasterHandler
master = ROSMasterHandler()
master.subscribeParam("/node", "http://127.0.0.1:9/", "/q/b/c")
answers = [master.setParam("/me", key, value)[0] for key, value in json.loads(sys.argv[1])]
print(json.dumps([answers, master.getParam("/me", "/")[2]]), flush=True)
master._shutdown()
"""
PART = st.sampled_from(["a", "b", "c"])
KEY = st.lists(PART, min_size=1, max_size=4).map(lambda parts: "/" + "/".join(parts))
VALUE = st.recursive(
    st.one_of(st.integers(0, 9), st.text("xy", max_size=3), st.booleans()),
    lambda inner: st.one_of(st.lists(inner, max_size=2), st.dictionaries(PART, inner, max_size=3)),
    max_leaves=6,
)
STEP = st.one_of(st.tuples(st.just("set"), KEY, VALUE), st.tuples(st.just("delete"), KEY, st.none()))


@pytest.fixture(scope="module")
def oracle() -> Iterator[Callable[[Any], Any]]:
    with answering("-c", ORACLE) as ask:
        yield ask


@pytest.mark.nightly
@settings(max_examples=examples(300), suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(steps=st.lists(STEP, max_size=12))
def test_the_mirror_equals_the_tree_of_rosmaster(oracle: Callable[[Any], Any], steps: list[Any]) -> None:
    there = mirror()
    for do, key, value in json.loads(json.dumps(steps)):
        if do == "set":
            put(there, key, value, HOST)
        else:
            there.delete(key)
    assert there.tree == oracle(steps)
    assert there.weight == measure(there.tree)[0]


def test_a_value_beyond_the_bound_is_refused_before_it_is_set() -> None:
    there = mirror(whole=1000)
    put(there, "/a", "x" * 500, HOST)
    with pytest.raises(LimitReachedError, match="the quota of one host is 1000"):
        put(there, "/b", "x" * 500, HOST)
    there.delete("/a")
    put(there, "/b", "x" * 500, HOST)


def test_key_and_value_together_are_bounded_in_depth() -> None:
    """The ROS master writes answers recursively, so it cannot return values that are too deep."""
    there = mirror(depth_limit=5)
    there.check("/a/b/c", measure({"d": [1]})[1])
    with pytest.raises(ProtocolError, match="nest deeper"):
        there.check("/a/b/c", measure({"d": [[1]]})[1])
    with pytest.raises(ProtocolError, match="nil"):
        measure({"b": [None]})


class OrderedServer(RosMaster):
    """A ROS master with the tree `tree`, and the calls that change it. `told` has the changes that subscribers get."""

    def __init__(self, there: ParameterMirror) -> None:
        super().__init__(1, limits=XmlRpcLimits())
        self.tree = mirror()
        self.requests: list[list[str]] = []
        self.parameters = there
        rights = ParameterRights(lambda: compile_policy("", file="p.ini"), FakeTrail())
        self.writes = ParameterCalls(self, there, self._told, rights, 1 << 20)
        self.broken: Exception | None = None
        self.told: list[tuple[str, str | None]] = []

    def _told(self, key: str, _value: Value, caller_id: str | None, _before: Value) -> None:
        self.told.append((key, caller_id))

    async def call(self, method: str, *params: Any) -> Any:
        return (await self.call_in_order([(method, params)]))[0]

    async def call_in_order(self, calls: Any) -> list[Any]:
        if any(value == "unwritable" for _method, params in calls for value in params[2:]):
            raise EncodingError("cannot be written")
        self.requests.append([f"{method} {params[1]}" for method, params in calls])
        if self.broken is not None:
            raise self.broken
        answers: list[Any] = []
        for method, (_caller, key, *value) in calls:
            if method == "setParam":
                put(self.tree, key, copy.deepcopy(value[0]), HOST)
            elif key == "/fault":
                answers.append(CallFailedError("a fault"))
                continue
            else:
                self.tree.delete(key)
            answers.append([1, method, key])
        return answers


def ordered(server: OrderedServer, *calls: tuple[Any, ...]) -> list[Any]:
    peer = Peer(ipaddress.ip_address("10.0.0.1"), "10.0.0.1", "10.0.0.2")
    caller = Caller(peer, "/me", 0)
    writes = [ParameterWrite(caller, key, value[0] if value else None) for _method, key, *value in calls]
    return autojump.run(server.writes.write(writes))


def test_a_run_is_one_request_in_its_order() -> None:
    server = OrderedServer(mirror())
    answers = ordered(server, ("setParam", "/a", {"b": 1}), ("deleteParam", "/a/b"), ("setParam", "/c", 2))
    assert server.requests == [["setParam /a", "deleteParam /a/b", "setParam /c"]]
    assert [answer[1] for answer in answers] == ["setParam", "deleteParam", "setParam"]
    assert server.parameters.tree == server.tree.tree == {"a": {}, "c": 2}
    assert server.told == [("/a", "/me"), ("/a/b", None), ("/c", "/me")]


@settings(max_examples=examples(100))
@given(st.lists(STEP, max_size=12))
def test_a_run_has_the_effect_of_single_calls(steps: list[tuple[str, str, Any]]) -> None:
    calls = [("setParam", key, value) if do == "set" else ("deleteParam", key) for do, key, value in steps]
    together, single = (OrderedServer(mirror()) for _ in range(2))
    ordered(together, *copy.deepcopy(calls))
    for call in copy.deepcopy(calls):
        ordered(single, call)
    assert together.parameters.tree == single.parameters.tree == together.tree.tree
    assert together.parameters.weight == single.parameters.weight


def test_an_unserializable_value_delays_no_other_call() -> None:
    server = OrderedServer(mirror())
    answers = ordered(server, ("setParam", "/a", 1), ("setParam", "/b", "unwritable"), ("setParam", "/c", 3))
    assert isinstance(answers[1], EncodingError)
    assert server.parameters.tree == {"a": 1, "c": 3}
    assert server.requests == [["setParam /a"], ["setParam /c"]]


def test_a_run_beyond_the_bound() -> None:
    server = OrderedServer(mirror(whole=1100))
    big = "x" * 400
    answers = ordered(
        server,
        ("setParam", "/a", big),
        ("setParam", "/b", big),
        ("setParam", "/c", big),
        ("setParam", "/d", 1),
    )
    assert [type(answer) for answer in answers] == [list, list, LimitReachedError, list]
    assert set(server.parameters.tree) == {"a", "b", "d"}
    assert server.parameters.weight <= 1100


def test_a_failing_part_and_a_lost_master() -> None:
    server = OrderedServer(mirror())
    answers = ordered(server, ("deleteParam", "/fault"), ("setParam", "/a", 1))
    assert isinstance(answers[0], CallFailedError)
    assert answers[1][0] == 1
    server.broken = CallFailedError("gone")
    answers = ordered(server, ("setParam", "/b", 1), ("deleteParam", "/a"))
    assert [type(answer) for answer in answers] == [CallFailedError, CallFailedError]
    assert server.parameters.tree == {"a": 1}
    assert server.told == [("/a", "/me")]


@settings(max_examples=examples(200))
@given(st.lists(STEP, max_size=14), st.data())
def test_repeated_changes_give_the_same_tree(steps: list[tuple[str, str, Any]], data: st.DataObject) -> None:
    noted: list[tuple[str, Any]] = []
    there = mirror(note=lambda key, value: noted.append((key, copy.deepcopy(value))))
    kept = []
    for do, key, value in [("", "", None), *steps]:
        if do == "set":
            put(there, key, copy.deepcopy(value), HOST)
        elif do == "delete":
            there.delete(key)
        kept.append((len(noted), copy.deepcopy(there.tree)))
    count, tree = data.draw(st.sampled_from(kept))
    first = data.draw(st.integers(0, count))
    again = mirror(tree, since=noted[first:])
    assert again.tree == there.tree
    assert again.weight == there.weight


@pytest.mark.nightly
@pytest.mark.parametrize("together", [False, True], ids=["alone", "in a run"])
def test_a_value_that_rosmaster_keeps_despite_its_error(together: bool) -> None:
    steps: list[Any] = [["/q", {"b": 1, "b/c": 2}], ["/", 7], ["/r", 3]]
    answered = subprocess.run(
        [PYTHON, "-c", WHOLE, json.dumps(steps)], capture_output=True, text=True, check=True, timeout=60
    ).stdout
    codes, tree = json.loads(answered.splitlines()[-1])
    assert codes[:2] == [-1, -1]

    class Failing(OrderedServer):
        async def call_in_order(self, calls: Any) -> list[Any]:
            keys = [key for key, _ in steps]
            return [[codes[keys.index(params[1])], method, 0] for method, params in calls]

    server = Failing(mirror())
    calls = [("setParam", key, copy.deepcopy(value)) for key, value in steps]
    if together:
        ordered(server, *calls)
    else:
        peer = Peer(ipaddress.ip_address("10.0.0.1"), "10.0.0.1", "10.0.0.2")
        for _method, *arguments in calls:
            autojump.run(server.writes.set_param(Caller(peer, "/me", 0), *arguments))
    assert server.parameters.tree == {name: value for name, value in tree.items() if name != "run_id"}
    assert server.parameters.weight == measure(server.parameters.tree)[0]


async def test_the_loop_runs_while_thousands_of_names_are_decided() -> None:
    world = await ControlParts.begun()
    world.reload(f"{OPEN}[Parameters]\nread /hidden/**=\nread default=*\n")
    put(world.parameters, "/mine", {f"p{number}": 1 for number in range(5000)}, HOST)
    put(world.parameters, "/hidden", {"key": 1}, HOST)
    rights = ParameterRights(lambda: world.current, world.records)
    calls = ParameterCalls(
        world.rosmaster, world.parameters, world.subscribers.parameter_set, rights, large=1 << 30
    )
    turns = 0

    async def others() -> None:
        nonlocal turns
        while True:
            turns += 1
            await asyncio.sleep(0)

    other = asyncio.create_task(others())
    answer: Any = await calls.get_param_names(Caller(Peer(HOST, str(HOST), "10.0.0.2"), "/me", 0))
    assert answer[2] == ["/run_id", *(f"/mine/p{number}" for number in range(5000))]
    assert turns >= 5
    other.cancel()
