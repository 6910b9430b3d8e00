import math
import random
from collections.abc import Iterator

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from rosmop.batch.jobs import unpack
from rosmop.learn.learner import learn
from rosmop.learn.passes import (
    AlarmFacts,
    AnyStep,
    ContentFacts,
    ContentStep,
    Facts,
    Run,
    TimeFacts,
    TimeStep,
    facts_of,
    run_here,
)
from rosmop.learn.recordings import LearningError
from rosmop.tests.acting import message
from rosmop.tests.learn.test_learner import DRIVES, START, Recorded
from roswire.standard import standard_definitions

DEFINITIONS = standard_definitions()
TOPICS = {
    "/s": "std_msgs/String",
    "/n": "std_msgs/Int32",
    "/a": "std_msgs/Float32MultiArray",
    "/b": "std_msgs/Bool",
}
TEXT = st.sampled_from([b"a", b"b", b"\xff", b"", *(bytes([65 + number]) for number in range(12))])
MESSAGES = st.one_of(
    st.tuples(st.just("/s"), TEXT.map(lambda text: len(text).to_bytes(4, "little") + text)),
    st.tuples(st.just("/n"), st.integers(-20, 20).map(lambda n: message("std_msgs/Int32", data=n))),
    st.tuples(st.just("/b"), st.booleans().map(lambda b: message("std_msgs/Bool", data=b))),
    st.tuples(
        st.just("/a"),
        st.lists(st.sampled_from([0.0, -0.0, 1.5, math.inf, math.nan]), max_size=8).map(
            lambda data: message("std_msgs/Float32MultiArray", data=data)
        ),
    ),
)
RECORDING = st.lists(st.tuples(MESSAGES, st.integers(1, 10**9)), min_size=1, max_size=30)


def recorded(number: int, rows: list[tuple[tuple[str, bytes], int]]) -> Recorded:
    time = START + number * 10**12
    found = []
    for (topic, data), gap in rows:
        time += gap
        found.append((topic, time, data))
    return Recorded(str(number), tuple(found), TOPICS)


def through_bytes(facts: Facts) -> Facts:
    result = unpack(msgspec.msgpack.encode(facts))
    assert isinstance(result, TimeFacts | ContentFacts | AlarmFacts)
    assert result == facts
    return result


def merged(facts: list[Facts], chance: random.Random) -> Facts:
    while len(facts) > 1:
        one, other = (facts.pop(chance.randrange(len(facts))) for _ in range(2))
        facts.append(one.merge(other))  # type: ignore[arg-type] # facts of one kind
    return facts[0]


@given(st.lists(RECORDING, min_size=2, max_size=5), st.integers(0, 2**32))
def test_facts_are_merged_in_any_order(
    recordings: list[list[tuple[tuple[str, bytes], int]]], seed: int
) -> None:
    chance = random.Random(seed)  # noqa: S311  no secret
    sources = [recorded(number, rows) for number, rows in enumerate(recordings)]
    spans = [
        (number, source.began, source.ended, number * 3, 3, TOPICS) for number, source in enumerate(sources)
    ]
    times: list[AnyStep] = [TimeStep(*span, gaps=4) for span in spans]
    periods = dict.fromkeys(TOPICS, (0.5, 2.0))
    contents: list[AnyStep] = [ContentStep(*span, rhythms=periods, ordered=["/n", "/s"]) for span in spans]
    alarms: list[Facts] = [AlarmFacts({chance.randrange(4): chance.randrange(1, 9)}) for _ in spans]
    for facts in (
        [through_bytes(facts_of(step, sources[step.recording], DEFINITIONS)) for step in times],
        [through_bytes(facts_of(step, sources[step.recording], DEFINITIONS)) for step in contents],
        alarms,
    ):
        assert merged([*facts], chance) == merged([*facts], chance) == merged(facts[::-1], chance)


def test_learning_does_not_depend_on_the_order_of_results() -> None:
    def shuffled(seed: int) -> Run:
        run = run_here(DRIVES, DEFINITIONS)

        def again(steps: list[AnyStep]) -> Iterator[tuple[int, Facts | LearningError]]:
            results = list(run(steps))
            random.Random(seed).shuffle(results)  # noqa: S311  no secret
            yield from results

        return again

    texts = {learn(DRIVES, DEFINITIONS, 0.3, shuffled(seed)).text for seed in range(4)}
    assert texts == {learn(DRIVES, DEFINITIONS, 0.3, run_here(DRIVES, DEFINITIONS)).text}


def test_a_recording_that_fails_later_is_named() -> None:
    run = run_here(DRIVES, DEFINITIONS)

    def failing(steps: list[AnyStep]) -> Iterator[tuple[int, Facts | LearningError]]:
        for number, facts in run(steps):
            lost = isinstance(steps[number], ContentStep) and steps[number].recording == 2
            yield number, LearningError("its worker died") if lost else facts

    learnt = learn(DRIVES, DEFINITIONS, 0.3, failing)
    assert learnt.failed == {2: "its worker died"}
    assert "partly, learnt from: its worker died" in learnt.text
