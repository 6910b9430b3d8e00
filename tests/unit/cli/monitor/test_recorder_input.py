"""`rosrv monitor replay --since`: what the flight recorder has of a time, what it has not, and what is refused."""

import json
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.channel.admin import AdminAnswer, Trouble, encode
from appliance.channel.answers.recording_answers import Recording, Recordings
from tests.support.answers import example
from tests.unit.cli.monitor.test_verbs import invoke, make_bag, number, records, write

SECOND = 10**9
BASE = time.time_ns() // SECOND - 1000
MONITOR = "s() { event e(int x) /t std_msgs/Int32 '{data:x}' { if (x > 7) { return; } } }"


class Kept:
    """An appliance's recordings and memory, each with a number every second from `began` on: seconds since `BASE`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.rows: list[Recording] = []
        self.memory: Recording | None = None
        self.trouble: Trouble = "failed"
        self.before = 60.0
        self.asked: list[dict[str, Any]] = []
        self.removes = False
        """Whether what was fetched is removed when the next is fetched."""

    def keep(self, name: str, began: int, ended: int, *, memory: bool = False, **more: Any) -> Recording:
        """One of them."""
        place = self.folder / "recordings" / name
        place.mkdir(parents=True)
        rows = [("/t", "std_msgs/Int32", float(BASE + at), number(at % 10)) for at in range(began, ended + 1)]
        make_bag(place / "recording.bag", rows)
        span = {"began": (BASE + began) * SECOND, "ended": (BASE + ended) * SECOND}
        recording = example(Recording, id=name, **span, **more)
        if memory:
            self.memory = recording
        else:
            self.rows.append(recording)
        return recording

    def answer(self, request: dict[str, Any]) -> AdminAnswer[Any]:
        """As control does."""
        self.asked.append(request)
        if request["verb"] == "recordings":
            body = example(
                Recordings,
                recordings=[],
                topics=["/*"],
                never=["/secret*", "std_msgs/Char"],
                before=self.before,
            )
            return AdminAnswer(True, Recordings(self.rows, body.topics, body.never, body.before))
        if request["verb"] == "recording memory":
            if self.memory is None:
                return AdminAnswer(False, error="it does not run at the moment", trouble=self.trouble)
            return AdminAnswer(True, self.memory)
        if self.removes and len(self.fetched) > 1:
            shutil.rmtree(self.folder / "recordings" / self.fetched[-2])
        known = [*self.rows, *([self.memory] if self.memory is not None else [])]
        return AdminAnswer(True, next(row for row in known if row.id == request["id"]))

    @property
    def fetched(self) -> list[str]:
        """The recordings of which it is on record that they were fetched."""
        return [one["id"] for one in self.asked if one["verb"] == "recording fetch"]


@pytest.fixture
def kept(tmp_path: Path) -> Iterator[Kept]:
    """An appliance that answers about what a test keeps."""
    kept = Kept(tmp_path)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(str(tmp_path / "admin.sock"))
    listener.listen()

    def serve() -> None:
        while True:
            try:
                peer, _ = listener.accept()
            except OSError:
                return
            with peer, peer.makefile("rb") as lines:
                for line in lines:
                    peer.sendall(encode(kept.answer(json.loads(line))) + b"\n")

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    yield kept
    listener.shutdown(socket.SHUT_RDWR)
    listener.close()
    thread.join(30)


def at(second: float) -> str:
    """That many seconds after `BASE`, as it is given."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(BASE + second))


def replay(kept: Kept, *arguments: object, text: str = MONITOR) -> Any:
    """Replay a monitor on it."""
    path = write(kept.folder, "s.rv", text)
    return invoke("replay", path, *arguments, "--state", kept.folder)


def test_what_recordings_have_together_is_judged_once_and_gaps_are_said(kept: Kept) -> None:
    """Only of the time that was asked for; what is missing within a recording, too."""
    kept.keep("a" * 20, 0, 19)
    kept.keep("b" * 20, 15, 29, why_not="3 messages had no room (see topics)", complete=False)
    kept.keep("c" * 20, 50, 59)
    kept.keep("d" * 20, 900, 909)
    found = records(replay(kept, "--since", at(5), "--until", at(70), "--json"))
    gaps = [(one["since"] - BASE, one["until"] - BASE) for one in found if one["kind"] == "gap"]
    assert [(round(since), round(until)) for since, until in gaps] == [(29, 50), (59, 70)]
    drops = [(one["bag"][0], one["time"] - BASE) for one in found if one["kind"] == "drop"]
    assert drops == [("a", 8), ("a", 9), ("a", 18), ("a", 19), ("b", 28), ("b", 29), ("c", 58), ("c", 59)]
    assert [(one["bag"], one["text"][:10]) for one in found if one["kind"] == "incomplete"] == [
        ("b" * 20, "3 messages")
    ]
    assert kept.fetched == ["a" * 20, "b" * 20, "c" * 20]
    shown = replay(kept, "--since", at(5), "--until", at(70)).output.splitlines()
    assert shown[0].startswith(f"not recorded: {at(29)[:-1]}")
    assert shown[0].endswith("(21.0 s)")
    assert shown[2] == f"{'b' * 20} is not complete: 3 messages had no room (see topics)"
    assert shown[-1] == "35 messages of 3 recordings"


def test_the_memory_follows_the_recordings(kept: Kept) -> None:
    """It is asked for what no recording has; all that there is, if no beginning is given."""
    kept.keep("a" * 20, 940, 949)
    kept.keep("e" * 20, 950, 999, memory=True)
    found = records(replay(kept, "--until", "1s", "--json"))
    assert [one["bag"] for one in found if one["kind"] == "drop"] == ["a" * 20] * 2 + ["memory"] * 10
    [order] = [one for one in kept.asked if one["verb"] == "recording memory"]
    assert order["since"] == (BASE + 949) * SECOND + 1
    gaps = [one for one in found if one["kind"] == "gap"]
    assert [round(one["since"] - BASE) for one in gaps] == [949, 999]  # the memory begins a second later


def test_the_memory_has_what_was_before_a_recording(kept: Kept) -> None:
    """What is in no recording yet is read of it, wherever it lies; what a recording has, of that."""
    kept.before = 3600.0
    kept.keep("a" * 20, 20, 29)
    kept.keep("e" * 20, 10, 49, memory=True)
    found = records(replay(kept, "--since", at(5), "--until", at(60), "--json"))
    drops = [(one["bag"][0], one["time"] - BASE) for one in found if one["kind"] == "drop"]
    assert drops == [("m", 18), ("m", 19), ("a", 28), ("a", 29), ("m", 38), ("m", 39), ("m", 48), ("m", 49)]
    assert kept.fetched == ["e" * 20, "a" * 20]
    gaps = [(one["since"] - BASE, one["until"] - BASE) for one in found if one["kind"] == "gap"]
    assert [(round(since), round(until)) for since, until in gaps] == [(5, 10), (49, 60)]


def test_what_is_removed_while_it_is_replayed_is_read_to_its_end(kept: Kept) -> None:
    """Somebody removes a recording, or asks for the memory as well: who has fetched it has it."""
    kept.before = 3600.0
    kept.keep("a" * 20, 20, 29)
    kept.keep("e" * 20, 10, 19, memory=True)
    kept.removes = True
    found = records(replay(kept, "--since", at(10), "--until", at(29), "--json"))
    drops = [(one["bag"][0], one["time"] - BASE) for one in found if one["kind"] == "drop"]
    assert drops == [("m", 18), ("m", 19), ("a", 28), ("a", 29)]
    shutil.rmtree(kept.folder / "recordings" / ("a" * 20))
    kept.memory = None
    kept.removes = False
    kept.trouble = "unknown"
    gone = replay(kept, "--since", at(20), "--until", at(29))
    assert (gone.exit_code, "is not there any more" in gone.output) == (2, True), gone.output


def test_a_time_that_is_not_in_memory_any_more_is_a_gap(kept: Kept) -> None:
    """The appliance began since: the recordings are judged all the same."""
    kept.before = 3600.0
    kept.keep("a" * 20, 20, 29)
    kept.trouble = "unknown"
    found = records(replay(kept, "--since", at(5), "--until", at(29), "--json"))
    assert [one["kind"] for one in found] == ["gap", "drop", "drop"]


@pytest.mark.parametrize(
    ("span", "words"),
    [(("--since", "2020-01-01", "--until", "2020-01-02"), "nothing is recorded of 2020-01-01"),
     (("--since", "1h"), "it does not run")],
)  # fmt: skip
def test_nothing_recorded_and_a_refusal_end_it(kept: Kept, span: tuple[str, ...], words: str) -> None:
    """Exit status 1; what there is instead is said."""
    kept.keep("a" * 20, 0, 19)
    result = replay(kept, *span)
    assert (result.exit_code, words in result.output) == (1, True), result.output
    assert kept.fetched == []


@pytest.mark.parametrize(
    ("topic", "kind", "words"),
    [
        ("/secret/a", "Int32", "recorder.never has /secret*"),
        ("/c", "Char", "recorder.never has std_msgs/Char"),
    ],
)
def test_a_topic_that_is_never_recorded_is_refused(kept: Kept, topic: str, kind: str, words: str) -> None:
    """Unless it is left out by --topic; nothing is fetched."""
    kept.keep("a" * 20, 0, 19)
    other = f"{MONITOR} o() {{ event e(int x) {topic} std_msgs/{kind} '{{data:x}}' {{ }} }}"
    refused = replay(kept, "--since", at(0), "--until", at(19), text=other)
    assert (refused.exit_code, words in refused.output) == (2, True), refused.output
    assert kept.fetched == []
    assert replay(kept, "--since", at(0), "--until", at(19), "--topic", "/t", text=other).exit_code == 0


@pytest.mark.parametrize(
    "wrong",
    [(), ("--bag", "a.bag", "--since", "1h"), ("--since", "soon"), ("--since", "1h", "--until", "2h")],
)
def test_a_span_that_makes_no_sense_is_refused(kept: Kept, wrong: tuple[str, ...]) -> None:
    """Exit status 2, and the appliance is not asked for messages."""
    assert replay(kept, *wrong).exit_code == 2
    assert kept.fetched == []
