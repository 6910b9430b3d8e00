"""A replay of the flight recorder's messages has the results of the monitors in force, with any settings."""

import inspect
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Literal

import msgspec
import pytest

from appliance.features.recorder.bag_writer import BagMessage, BagWriter
from appliance.features.recorder.mcap import as_mcap
from appliance.relay.monitors.monitor_sets import monitor_set
from rosmop.batch.replay_job import Specifications
from rosmop.recordings.recording import definitions_of, open_recording
from rosmop.recordings.replay import replay
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import MessageSender, Outcome
from rosmop.tests.acting import message
from roswire.standard import standard_definitions
from tests.support.stated import stated

KIND = "std_msgs/Int32"
TEXTS = {
    "faults.rv": "faults() { int zero; event e(int x) /e std_msgs/Int32 '{data:x}' { int k = x / zero; x = 1; } }",
    "sliced.rv": """sliced(int id) { int n; event g(int id) /g std_msgs/Int32 '{data:id}' { n++; }
        event h(int id) /h std_msgs/Int32 '{data:id}' { if (n > 0) { return; } } }""",
    "hosts.rv": "hosts() { event e() /f std_msgs/Int32 '{}' { if (host(e) == \"10.0.0.2\") { DROP; } } }",
}
SENDERS = {source: (f"10.0.0.{source}", f"/node{source}") for source in (1, 2, 3)}
SENT = [(topic, source, 10 * source + x) for source in SENDERS for topic in "efgh" for x in range(8)]
TIME = 10**12


def recorded(folder: Path) -> Iterator[Path]:
    known = standard_definitions()
    about = {"type": KIND, "md5sum": known.md5sum(KIND), "message_definition": known.full_text(KIND)}
    writer = BagWriter(folder / "a.bag", {})
    numbers = {
        (topic, source): writer.connect(about | {"topic": f"/{topic}", "callerid": caller, "host": host})
        for topic in "efgh"
        for source, (host, caller) in SENDERS.items()
    }
    writer.write(
        BagMessage(numbers[topic, source], TIME + place, message(KIND, data=x))
        for place, (topic, source, x) in enumerate(SENT)
    )
    writer.close()
    yield folder / "a.bag"
    (folder / "a.mcap").write_bytes(b"".join(as_mcap(folder / "a.bag")))
    yield folder / "a.mcap"


def result(outcome: Outcome) -> tuple[object, ...]:
    faults = [fault.text for fault in outcome.faults]
    return outcome.result, bytes(outcome.buffer), outcome.dropped_by, outcome.changed_by, faults


def test_each_setting_of_the_relay_that_decides_is_given_to_a_replay() -> None:
    of_time = {"patience", "shadow_patience", "deadlines"}
    of_texts = {"compiled", "fast", "shadows"}
    of_messages = {"holder_of"}
    given = {field.name for field in msgspec.structs.fields(Specifications)}
    assert inspect.signature(MonitorSet.of).parameters.keys() <= of_time | of_texts | of_messages | given


@pytest.mark.parametrize("slices", [1, 5, 100_000])
@pytest.mark.parametrize("on_fault", ["drop", "pass"])
def test_settings_decide_in_a_replay_as_in_the_relay(
    tmp_path: Path, on_fault: Literal["drop", "pass"], slices: int
) -> None:
    statement = stated(1, [*TEXTS.items()], on_fault=on_fault, slices=slices)
    live = monitor_set(statement, lambda source: SENDERS[source][0])
    assert isinstance(live, MonitorSet)
    live.name_senders(lambda source: SENDERS[source])
    live.start(TIME)
    expected = [
        result(
            live.process(f"/{topic}", bytearray(message(KIND, data=x)), TIME + place, MessageSender(source))
        )
        for place, (topic, source, x) in enumerate(SENT)
    ]
    specifications = Specifications(TEXTS, {}, on_fault=on_fault, slices=slices)
    for path in recorded(tmp_path):
        with closing(open_recording(path)) as reader:
            monitors = specifications.monitors(definitions_of(reader))
            assert [result(step.outcome) for step in replay(monitors, reader, None)] == expected
