"""Specifications in shadow mode do not affect messages, and their reports equal those of enabled ones."""

from collections.abc import Collection, Iterator
from random import Random

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from rosmop.check.sources import compiled_from
from rosmop.form.findings import SpecificationError
from rosmop.logics.catalogue import LOGICS
from rosmop.run.engine import MonitorSet
from rosmop.run.execution import OnFault
from rosmop.run.outcomes import Outcome
from rosmop.tests.acting import message
from rosmop.tests.examples import examples
from rosmop.tests.random_specifications import Messages, Specifications, definitions

FEW = settings(max_examples=examples(60), suppress_health_check=list(HealthCheck))
PROPERTIES = {
    "fsm": "fsm: one [ e0 -> two, default one ] two [ e1 -> one, default two ]\n@two { DROP; }",
    "tfsm": "tfsm: one [ e0 -> two, default one ] two [ e1 -> one, timeout 3ms -> one ]\n@fail { DROP; __RESET; }\n"
    "@timeout { late++; }\n",
    "ere": "ere: (e0 e1)*\n@fail { DROP; __RESET; }",
    "cfg": "cfg: S -> e0 S e1 | epsilon\n@fail { DROP; __RESET; }",
    "ltl": "ltl: [](e0 => o e1)\n@violation { DROP; __RESET; }",
    "ptltl": "ptltl: e1 -> (*) e0\n@violation { DROP; }",
    "mtl": "mtl: e1 => once[0,2ms] e0\n@violation { DROP; }",
    "pattern": "pattern: globally: e0 causes e1 within 3ms\n@violation { late++; __RESET; }",
    "srs": "srs: e0 e1 -> #epsilon . e1 -> #fail .\n@fail { DROP; __RESET; }",
    "ptcaret": "ptcaret: begin -> (*a) end\n@violation { DROP; }",
}


def number(data: int) -> bytes:
    return bytes([data])


class Both:
    def __init__(self, texts: dict[str, str], shadowed: str, on_fault: OnFault = "drop") -> None:
        self.shadowed, self.on_fault = shadowed, on_fault
        place = next(at for at, text in enumerate(texts.values()) if text.startswith(shadowed))
        others = {file: text for file, text in texts.items() if not text.startswith(shadowed)}
        self.texts = dict(list(texts.items())[: place + 1])
        self.enabled = MonitorSet.of(compiled_from(self.texts, definitions()), on_fault)
        self.with_shadow = MonitorSet.of(compiled_from(texts, definitions()), on_fault, shadows=[shadowed])
        self.without = MonitorSet.of(compiled_from(others, definitions()), on_fault)
        self.stories = [self.story(self.enabled.start(0)), list(self._start())]
        self.without.start(0)

    def _start(self) -> Iterator[object]:
        outcome = self.with_shadow.start(0)
        for shadowed in outcome.shadowed:
            yield from self.story(shadowed)
        assert not self.story(outcome)

    def give(self, topic: str, body: bytes, time: int) -> None:
        done = self.enabled.process(topic, bytearray(body), time)
        self.stories[0] += self.story(done)
        left = self.with_shadow.process(topic, bytearray(body), time)
        expected = self.without.process(topic, bytearray(body), time)
        for monitors, outcome in ((self.enabled, done), (self.with_shadow, left), (self.without, expected)):
            for name in outcome.began_holding:  # in shadow mode it would hold nothing
                monitors.resume(name)
        assert (left.result, bytes(left.buffer)) == (expected.result, bytes(expected.buffer))
        assert (list(left.events), list(left.verdicts)) == (list(expected.events), list(expected.verdicts))
        tapped, self.with_shadow.tapped[:] = list(self.with_shadow.tapped), []
        for one in tapped:
            would = one.give()
            self.stories[1] += self.story(would)
            assert (would.result == "dropped") is (done.result == "dropped")
            if would.result != "dropped":
                assert bytes(would.buffer) == bytes(done.buffer)

    def promote(self, time: int) -> None:
        self.check(time)
        following = MonitorSet.of(compiled_from(self.texts, definitions()), self.on_fault)
        following.succeed(self.with_shadow, time)
        assert not following.began
        self.with_shadow = following

    def go_on(self, topic: str, body: bytes, time: int) -> None:
        self.stories[0] += self.story(self.enabled.process(topic, bytearray(body), time))
        self.stories[1] += self.story(self.with_shadow.process(topic, bytearray(body), time))

    def check(self, time: int) -> list[object]:
        for place, sets in enumerate(([self.enabled], [self.with_shadow, *self.with_shadow.shadows])):
            for outcome in [outcome for one in sets for outcome in one.advance(time)]:
                self.stories[place] += self.story(outcome)
        assert self.stories[0] == self.stories[1]
        return self.stories[0]

    def story(self, outcome: Outcome) -> list[object]:
        before = [told for earlier in outcome.before for told in self.story(earlier)]
        did: list[object] = [event for event in outcome.events if event.startswith(f"{self.shadowed}.")]
        did += [verdict for verdict in outcome.verdicts if verdict.monitor == self.shadowed]
        did += [(fault.position, fault.text) for fault in outcome.faults if fault.monitor == self.shadowed]
        did += [one for one in outcome.log if one.monitor == self.shadowed]
        did += [
            (one._replace(site=0), outcome.sites[one.site].position)
            for one in outcome.published
            if one.monitor == self.shadowed
        ]
        did += ["dropped", outcome.reason] * (outcome.dropped_by == self.shadowed)
        return [*before, (outcome.time, did)] if did else before


# The same as when it is enabled


@FEW
@example(seed=11435, wild=[])  # this one publishes, and follows others that publish
@given(seed=st.integers(0, 1 << 30), wild=st.lists(st.binary(max_size=80), max_size=3))
def test_random_specifications_and_messages(seed: int, wild: list[bytes]) -> None:
    texts = {f"{place}.rv": text for place, text in enumerate(Specifications(seed).texts())}
    try:
        both = Both(texts, f"s{seed % len(texts)}", ("drop", "pass")[seed % 2])
    except SpecificationError:
        return  # the random text is not a valid specification
    messages, time = Messages(seed), 0
    for _ in range(4):
        traffic = messages.traffic()
        for body in (*traffic.bodies(), *wild):
            time += 400_000
            both.give(traffic.topic, body, time)
    both.promote(time)
    for traffic in (messages.traffic() for _ in range(2)):
        for body in traffic.bodies():
            time += 400_000
            both.go_on(traffic.topic, body, time)
    both.check(time)


def test_the_random_specifications_reach_every_outcome() -> None:
    found: set[str] = set()
    for seed in range(40):
        try:
            both = Both({"0.rv": Specifications(seed).texts()[0]}, "s0")
        except SpecificationError:
            continue
        messages, time = Messages(seed), 0
        for traffic in (messages.traffic() for _ in range(4)):
            for body in traffic.bodies():
                time += 400_000
                both.give(traffic.topic, body, time)
        story = str(both.check(time))
        found |= {word for word in ("dropped", "Verdict", "s0.tick", "Position", "LogLine") if word in story}
        if len(found) == 5:
            return
    pytest.fail(f"only {found}")


@pytest.mark.parametrize("logic", LOGICS)
def test_every_logic(logic: str) -> None:
    names = ("begin", "end") if logic == "ptcaret" else ("e0", "e1")
    events = "".join(
        f"event {name}() /n std_msgs/UInt8 '{{data:{at}}}' {{ }} " for at, name in enumerate(names)
    )
    texts = {
        "0.rv": "a() { event e(int n) /n std_msgs/UInt8 '{data:n}' { if (n == 2) n = 1; if (n == 3) { return; } } }",
        "1.rv": f"s() {{ int late = 0; {events} {PROPERTIES[logic]} }}",
    }
    both, random, time = Both(texts, "s"), Random(logic), 0  # noqa: S311  draws examples
    for _ in range(60):
        time += random.choice((300_000, 1_000_000, 3_500_000))
        both.give("/n", number(random.randrange(4)), time)
    both.promote(time)
    for _ in range(30):
        time += random.choice((300_000, 1_000_000, 3_500_000))
        both.go_on("/n", number(random.randrange(4)), time)
    assert "Verdict" in str(both.check(time + 10_000_000))


@pytest.mark.parametrize("logic", ["fsm", "ere", "cfg", "ltl", "ptltl", "ptcaret", "tick"])
def test_every_parametric_logic(logic: str) -> None:
    names = ("begin", "end") if logic == "ptcaret" else ("e0", "e1")
    events = "".join(
        f"event {name}(int n) /n{at} std_msgs/UInt8 '{{data:n}}' {{ seen++; }} "
        for at, name in enumerate(names)
    )
    rule = PROPERTIES.get(logic, "event tick() every 2ms { if (seen > 2) { seen = 0; LOG } }")
    rule = rule.replace("DROP;", "DROP; LOG").replace("LOG", 'ROS_WARN("%d: %d", n, seen);')
    texts = {
        "0.rv": "a() { event e(int n) /n0 std_msgs/UInt8 '{data:n}' { if (n == 2) n = 1; if (n == 3) { return; } } }",
        "1.rv": f"s(int n) {{ int seen = 0; creation {events} {rule} }}",
    }
    both, random, time = Both(texts, "s"), Random(logic), 0  # noqa: S311  draws examples
    for _ in range(100):
        time += random.choice((300_000, 1_000_000, 3_500_000))
        both.give(f"/n{random.randrange(2)}", number(random.randrange(6)), time)
    both.promote(time)
    for _ in range(30):
        time += random.choice((300_000, 1_000_000, 3_500_000))
        both.go_on(f"/n{random.randrange(2)}", number(random.randrange(6)), time)
    story = str(both.check(time + 10_000_000))
    assert "LogLine" in story
    assert logic == "tick" or "Verdict" in story


@pytest.mark.parametrize("handler", ["@enforced { late++; }", "@violation { late++; __RESET; }"])
def test_publications_enforced_at_a_deadline(handler: str) -> None:
    remedy = "help() { std_msgs::UInt8 one; one.data = late; PUBLISH(/n1, std_msgs/UInt8, one); }"
    events = "".join(f"event e{at}() /n{at} std_msgs/UInt8 '{{}}' {{ }} " for at in range(2))
    rule = f"pattern: globally: e0 causes e1 within 3ms enforced by help {handler}"
    texts = {"1.rv": f"s() {{ int late = 0; {remedy} {events} {rule} }}"}
    both, random, time = Both(texts, "s"), Random(handler), 0  # noqa: S311  draws examples
    for _ in range(100):
        time += random.choice((300_000, 1_000_000, 3_500_000))
        both.give(f"/n{random.randrange(2)}", number(0), time)
    both.promote(time)
    for _ in range(30):
        time += random.choice((300_000, 1_000_000, 3_500_000))
        both.go_on(f"/n{random.randrange(2)}", number(0), time)
    assert "Publi" in str(both.check(time + 10_000_000))


# Its position among other specifications

NUMBER = "int n) /n std_msgs/UInt8 '{data:n}'"


def shadow(*texts: str, shadowed: Collection[str]) -> MonitorSet:
    found = MonitorSet.of(
        compiled_from({f"{at}.rv": text for at, text in enumerate(texts)}, definitions()), shadows=shadowed
    )
    found.start(0)
    return found


def test_requests_and_responses() -> None:
    text = """s() { event asked(bool on) service /mode std_srvs/SetBool request '{data:on}' { if (on) { return; } } }"""
    monitors = shadow(text, shadowed=["s"])
    assert monitors.process_service("/mode", "request", b"\x01", 1).result == "passed"
    assert monitors.tapped.pop().give().result == "dropped"
    assert monitors.service_type_of("/mode") is None
    assert monitors.service_type_of("/mode", shadowed=True) == "std_srvs/SetBool"


def test_specifications_that_share_variables_are_in_shadow_mode_together() -> None:
    """A message that one would have dropped is hidden from the next."""
    monitors = shadow(
        f"a() {{ int k = 0; event e({NUMBER} {{ k = n; if (n == 3) {{ return; }} }} }}",
        f"b() {{ event e({NUMBER} when (k > 1) {{ return; }} }}",
        f"c() {{ event e({NUMBER} {{ n = 7; }} }}",
        shadowed=["b"],
    )
    assert [outcome.name for outcome in monitors.shadowed] == ["a", "b"]
    assert [monitor.name for monitor in monitors.monitors] == ["c"]
    for data in (1, 2, 3):
        monitors.process("/n", number(data), data)
    assert [one.give().dropped_by for one in monitors.tapped] == ["", "b", "a"]


def test_a_disabled_specification_sees_nothing_and_holds_nothing() -> None:
    text = f"hold a() {{ event e({NUMBER} {{ return; }} }}"
    monitors = MonitorSet.of(compiled_from({"0.rv": text}, definitions()), shadows=["a"])
    monitors.start(0, restarted=True)
    assert not monitors.shadowed[0].held
    monitors.switch({"a": False}, 1)
    assert not monitors.wants("/n")
    monitors.switch({"a": True}, 2)
    monitors.process("/n", number(1), 3)
    assert [one.give().dropped_by for one in monitors.tapped] == ["a"]
    following = MonitorSet.of(compiled_from({"0.rv": text}, definitions()))
    following.succeed(monitors, 4)
    assert not following.monitors[0].held


def test_an_incomplete_state_is_reset_when_it_is_enforced() -> None:
    text = f"a() {{ int k = 0; event e({NUMBER} {{ k += 1; if (n == 9) {{ n = n / (n - 9); }} }} }}"
    sources = {"0.rv": text}
    monitors = shadow(text, shadowed=["a"])
    for data in (1, 9):
        monitors.process("/n", number(data), data)
    for one in monitors.tapped:
        one.give()
    still = MonitorSet.of(compiled_from(sources, definitions()), shadows=["a"])
    still.succeed(monitors, 10, ["a"])
    assert (still.shadows[0].value("a", "k"), still.shadowed[0].faults, still.began) == (2, 1, ())
    anew, kept = (MonitorSet.of(compiled_from(sources, definitions())) for _ in range(2))
    kept.succeed(still, 11)
    assert (kept.value("a", "k"), kept.monitors[0].faults, kept.began) == (2, 0, ())
    anew.succeed(still, 11, ["a"])
    assert (anew.value("a", "k"), anew.began) == (0, ("a",))


def test_a_topic_of_shadow_mode_only_has_a_type_there_only() -> None:
    monitors = shadow("s() { event e() /chatter std_msgs/String '{}' { } }", shadowed=["s"])
    assert monitors.wants("/chatter")
    assert (monitors.type_of("/chatter"), monitors.type_of("/chatter", shadowed=True)) == (
        None,
        "std_msgs/String",
    )
    assert monitors.process("/chatter", message("std_msgs/String", data="x"), 1).result == "passed"
