from math import inf
from random import Random

import pytest

from rosmop.check.sources import compiled_from
from rosmop.fast.abi import MAX_KEPT
from rosmop.fast.build import require_loadable
from rosmop.fast.serialization import encode
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import MessageSender
from rosmop.tests.acting import message
from rosmop.tests.both_ways import BothWays, plain, stamped, state_of
from rosmop.tests.examples import examples
from rosmop.tests.on_module import on_module
from rosmop.tests.random_specifications import definitions

TEXT = """s() { double own = 0; double other = 0; bool ever = false;
    event a(int c) /plain own/Plain '{count:c}' when (c > 0) {
        own = age(a); other = age(b); ever = seen(a);
        if (c == 1) { return; } if (c == 2) { DROP; } if (c == 3) { c = 1 / (c - 3); } }
    event b(int c) /plain own/Plain '{count:c}' when (c < 5) { } }"""


@pytest.mark.parametrize("seed", range(examples(60)))
def test_ages_are_those_of_a_naive_account(seed: int) -> None:
    both, random = BothWays(TEXT), Random(seed)  # noqa: S311  draws examples, not keys
    last, time = {"a": -inf, "b": -inf}, 1 << 60
    for _ in range(40):
        time += random.choice((-5, 0, 1, 10**8, 3 * 10**9, 10**17))
        count = random.randrange(8)
        expected = {name: (time - then) / 1e9 if -inf < then <= time else inf for name, then in last.items()}
        both.check([plain(count)], time=time)
        if count > 0:
            values = [both.interpreter.value("s", name) for name in ("own", "other", "ever")]
            assert values == [expected["a"], expected["b"], last["a"] > -inf]
        if count > 3:
            last["a"] = time
        if count in {0, 4}:
            last["b"] = time
    assert both.came["together"]


def test_an_age_outlives_the_process() -> None:
    sets = [on_module(compiled_from({"x.rv": TEXT}, definitions())) for _ in range(2)]
    sets[0].start(0)
    [group] = sets[0].kept_groups()
    sets[0].judge("/plain", plain(7), 3)
    base = group.base()
    sets[0].judge("/plain", plain(7), 5)
    assert group.cells()
    sets[1].recover([(group.names, group.layout, base, group.cells())], {}, 9)
    sets[1].judge("/plain", plain(7), 9)
    assert sets[1].value("s", "own") == 4e-9
    assert state_of(sets[1])[-2:] == ["age(a) 9", "age(b) -1"]


def test_each_slice_has_ages_of_its_own() -> None:
    text = """s(int c) { event a(int c) /t std_msgs/Int32 '{data:c}' { }
        event b(int c) /u std_msgs/Int32 '{data:c}' { ROS_INFO("%g", age(a)); } }"""
    monitors = MonitorSet.of(compiled_from({"x.rv": text}, definitions()))
    monitors.start(0)
    said = []
    for time, topic, number in ((1, "/t", 1), (2, "/t", 2), (4, "/u", 1), (5, "/u", 2), (6, "/u", 3)):
        outcome = monitors.process(topic, message("std_msgs/Int32", data=number), time * 10**9)
        said += [line.text for line in outcome.log]
    assert said == ["3", "3", "inf"]


def test_equal_texts_with_ages_give_equal_sets() -> None:
    data = {encode(compiled_from({"x.rv": TEXT}, definitions())) for _ in range(2)}
    [one] = data
    require_loadable(one)


SENDERS = """s() { std::string mine; int n = 0;
    event a(int c) /plain own/Plain '{count:c}' {
        if (caller(a) == "/evil") { return; } mine = host(a); if (host(a) == "10.0.0.7") { n++; } }
    event b() /stamped own/Stamped '{}' { ROS_INFO("%s %s", host(a).c_str(), caller(a).c_str()); } }"""


@pytest.mark.parametrize("seed", range(examples(60)))
def test_senders_are_those_of_a_naive_account(seed: int) -> None:
    random = Random(seed)  # noqa: S311  draws examples, not keys
    long = "/" + "x" * (MAX_KEPT + 1)
    who = {1: ("10.0.0.7", "/a"), 2: ("10.0.0.8", "/evil"), 3: ("", long), 4: ("fe80::1", "/b")}
    compiled = compiled_from({"x.rv": SENDERS}, definitions())
    sets = on_module(compiled), MonitorSet.of(compiled)
    for one in sets:
        one.name_senders(lambda source: who[source])
        one.start(0)
    last, count = ("", ""), 0
    for time in range(1, 60):
        source = random.choice((0, 1, 2, 3, 4, 1))
        topic, body = random.choice((("/plain", plain(7)), ("/stamped", stamped())))
        host, caller = who.get(source, ("", ""))
        for one, process in zip(sets, (sets[0].judge, sets[1].process), strict=True):
            outcome = process(topic, bytearray(body), time, MessageSender(source))
            if topic == "/stamped":
                assert [line.text for line in outcome.log] == [" ".join(last)]
                continue
            assert (outcome.result == "dropped") == (caller == "/evil")
            if caller != "/evil":
                assert one.value("s", "mine") == host.encode()
                assert one.value("s", "n") == count + (host == "10.0.0.7")
        if topic == "/plain" and caller != "/evil":
            last, count = (host, caller), count + (host == "10.0.0.7")


def test_the_sender_is_read_in_the_module() -> None:
    monitors = on_module(compiled_from({"x.rv": SENDERS}, definitions()))
    assert monitors.lane("/plain")


def test_a_published_message_has_no_sender() -> None:
    text = """a() { event e() /plain own/Plain '{}' { std_msgs::String s; PUBLISH(/told, std_msgs/String, s); } }
        b() { event e() /told std_msgs/String '{}' { ROS_INFO("<%s>", caller(e).c_str()); } }"""
    monitors = MonitorSet.of(compiled_from({"x.rv": text}, definitions()))
    monitors.name_senders(lambda _: ("10.0.0.7", "/a"))
    monitors.start(0)
    [judged] = monitors.process("/plain", bytearray(plain()), 1, MessageSender(1)).judged.values()
    assert [line.text for line in judged.log] == ["<>"]
