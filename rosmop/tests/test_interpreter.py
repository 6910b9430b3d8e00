from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rosmop.check.sources import compiled_from
from rosmop.form import nodes
from rosmop.form.findings import SpecificationError
from rosmop.run.engine import MonitorSet
from rosmop.run.execution import OnFault
from rosmop.runtime.values import ValueCodec
from rosmop.tests.acting import message
from rosmop.tests.both_ways import state_of
from rosmop.tests.examples import examples
from rosmop.tests.interpreted import beside, check_same
from rosmop.tests.on_module import on_module
from rosmop.tests.random_specifications import Messages, Specifications, definitions
from rosmop.types import value_types
from rosmop.types.messages import MessageTypes
from roswire.definitions import Definitions
from roswire.standard import standard_definitions

MONITORS = Path(__file__).parents[2] / "monitors"
FEW = settings(max_examples=examples(120), suppress_health_check=list(HealthCheck))


def check(given: MonitorSet, traffic: list[tuple[str, bytes]], step_ns: int) -> None:
    other, monitors = beside(given), on_module(given.compiled, given.on_fault)
    check_same(monitors.start(0), other.start(0))
    for number, (topic, body) in enumerate(traffic):
        time = number * step_ns
        check_same(monitors.judge(topic, bytearray(body), time), other.process(topic, bytearray(body), time))
    for specification in monitors.compiled.specifications:
        for variable in specification.variables:
            known, found = (each.value(specification.name, variable) for each in (monitors, other))
            assert repr(known) == repr(found)  # a NaN equals a NaN here
    assert state_of(monitors) == state_of(other)


@FEW
@given(
    seed=st.integers(0, 1 << 30),
    on_fault=st.sampled_from(["drop", "pass"]),
    step_ns=st.sampled_from([1, 700_000]),
    wild=st.lists(st.binary(max_size=80), max_size=4),
)
def test_single_messages_have_the_outcomes_of_the_interpreter(
    seed: int, on_fault: OnFault, step_ns: int, wild: list[bytes]
) -> None:
    sources = {f"{place}.rv": text for place, text in enumerate(Specifications(seed).texts())}
    messages = Messages(seed)
    together = [
        (one.topic, body) for one in (messages.traffic() for _ in range(4)) for body in (*one.bodies(), *wild)
    ]
    try:
        monitors = MonitorSet.of(compiled_from(sources, definitions(), margins=seed % 4 > 1), on_fault)
    except SpecificationError:
        return  # the random text is not a valid specification
    check(monitors, together, step_ns)


@pytest.mark.parametrize(
    "wrong",
    [
        ["Nothing", 1],
        ["Break", "1"],
        ["Break"],
        ["Evaluate", 1, ["Read", ["Integer", 8, True], "x"]],
        ["Evaluate", 1, ["Break", 1]],
        ["Evaluate", 1, ["Literal", ["Void"], "text"]],
    ],
    ids=["kind", "type", "missing", "missing in a type", "statement as a value", "no value of the language"],
)
def test_data_that_is_not_a_form_is_rejected(wrong: list[object]) -> None:
    statement = msgspec.msgpack.Decoder(nodes.Statement)
    assert statement.decode(msgspec.msgpack.encode(["Break", 1])) == nodes.Break(1)
    with pytest.raises(msgspec.ValidationError):
        statement.decode(msgspec.msgpack.encode(wrong))
    deep = b"\x93\xa4Loop\x01\x91" * 100_000 + b"\x92\xa5Break\x01"
    with pytest.raises(RecursionError):
        statement.decode(deep)


def shipped() -> MonitorSet:
    trigger = MONITORS / "msg" / "landshark_msgs" / "PaintballTrigger.msg"
    own = Definitions.from_files({"landshark_msgs/PaintballTrigger.msg": trigger.read_text()})
    sources = {path.name: path.read_text() for path in sorted(MONITORS.glob("*.rv"))}
    return MonitorSet.of(compiled_from(sources, standard_definitions().merge(own)))


def a_value(values: ValueCodec, kind: value_types.Type) -> st.SearchStrategy[Any]:
    if isinstance(kind, value_types.RecordType):
        return st.tuples(*(a_value(values, field) for field in values.fields(kind))).map(list)
    if isinstance(kind, value_types.VectorType):
        most = 4 if kind.length is None else kind.length
        return st.lists(a_value(values, kind.element), min_size=kind.length or 0, max_size=most)
    if isinstance(kind, value_types.IntegerType):
        return st.integers(kind.least, kind.most)
    known: dict[value_types.Type, st.SearchStrategy[Any]] = {
        value_types.BOOL: st.booleans(),
        value_types.STRING: st.sampled_from([b"turret_tilt", b"turret_pan", b"", b"x"]),
        value_types.FLOAT: st.floats(width=32),
        value_types.DOUBLE: st.floats() | st.floats(-2, 2),
        value_types.TIME: st.integers(0, 1 << 40),
        value_types.DURATION: st.integers(-(1 << 40), 1 << 40),
    }
    return known[kind]


@FEW
@given(data=st.data())
def test_shipped_specifications(data: st.DataObject) -> None:
    monitors = shipped()
    values = ValueCodec(MessageTypes(monitors.definitions))
    traffic = []
    for topic in data.draw(st.lists(st.sampled_from(sorted(monitors.topics)), min_size=1, max_size=12)):
        kind = value_types.RecordType(monitors.topics[topic])
        body = bytearray()
        values.encoder(kind)(data.draw(a_value(values, kind)), body)
        end = data.draw(st.just(len(body)) | st.integers(0, len(body)))
        traffic.append((topic, bytes(body[:end])))
    check(monitors, traffic, 50_000_000)


@pytest.mark.parametrize(
    "body",
    [
        'if (names.size() > 1) { names[0] = "other"; position.push_back(1.5); }',
        "position[5] = 1;",
        "stamp.sec = 7; stamp.nsec += 1;",
        "v = MESSAGE; v.velocity.clear(); PUBLISH(/out, sensor_msgs/JointState, v);",
        "std::vector<double> all(3, 2.5); all.insert(all.begin() + 1, position.size()); position = all;",
        "for (auto &name : names) { name += 'x'; }",
        "double sum = 0; for (double p : position) { if (p < 0) { continue; } sum += p; } position[0] = sum;",
        "switch (names.size()) { case 0: return; case 1: n = 1; case 2: n += 2; break; default: n = -1; } f(n);",
        "std::sort(position.begin(), position.end()); n = std::accumulate(position.begin(), position.end(), 0);",
        "std::string s = names[0]; while (true) { s += s; }",
        "n = deep(0);",
        "n = deep(1); position.resize(n);",
        "swap(position[0], position[1]);",
    ],
)
def test_growing_values_and_fields_of_any_size_do_the_same(body: str) -> None:
    text = f"""s() {{ int n = 0; sensor_msgs::JointState v;
    void f(int &x) {{ x = x * 3; }}
    void swap(double &a, double &b) {{ double c = a; a = b; b = c; }}
    int deep(int down) {{ if (down == 0) {{ return deep(0); }} return down > 50 ? 5 : deep(down + 1) + 1; }}
    event e(std::vector<std::string> names, double[] position, ros::Time stamp) /j sensor_msgs/JointState
    '{{name:names, position:position, header.stamp:stamp}}' {{ {body} ROS_INFO("%d %f", n, position[0]); }} }}"""
    monitors = MonitorSet.of(compiled_from({"x.rv": text}, standard_definitions()))
    told = [
        message("sensor_msgs/JointState", name=["a", "b"], position=[0.5, -1.0]),
        message("sensor_msgs/JointState", name=["a"], position=[3.0], velocity=[1.0]),
        message("sensor_msgs/JointState"),
    ]
    check(monitors, [("/j", body) for body in told], 1)
