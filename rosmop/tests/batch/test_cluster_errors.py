import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from rosmop.batch.ray_cluster import _reason
from rosmop.batch.replay_job import Specifications
from rosmop.recordings.replay import EVER
from rosmop.tests.batch.test_many_recordings import SPECIFICATION, make_bag, rosmop
from rosmop.tool.command_context import CommandContext
from rosmop.tool.replay_report import ReplayReport
from rosmop.tool.run_command import run_spans


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        ("one\ntwo", "one"),
        ("announced:\ntwo\nthree", "announced: two"),
        (
            "failure from server:\nTraceback (most recent call last):\n  File x\nRuntimeError: see y.err\n",
            "failure from server: RuntimeError: see y.err",
        ),
    ],
)
def test_the_line_has_the_cause(message: str, reason: str) -> None:
    assert _reason(ConnectionAbortedError(message)) == f"ConnectionAbortedError: {reason}"


class _Ray(ModuleType):
    """Acts as Ray's client, whose head dies after `left` results, at the call `at`."""

    class exceptions:  # noqa: N801  Ray's name
        RayError = type("RayError", (Exception,), {})

    def __init__(self, at: str, error: Exception, left: int) -> None:
        super().__init__("ray")
        self.at, self.error, self.left = at, error, left
        self._private = SimpleNamespace(worker=SimpleNamespace())

    def init(self, *_given: object, **_options: object) -> None:
        self._reach("init")

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 1}

    def remote(self, **_options: object) -> Callable[[Callable[[bytes], bytes]], object]:
        def submitted(work: Callable[[bytes], bytes], job: bytes) -> object:
            self._reach("remote")
            return work, job

        return lambda work: SimpleNamespace(remote=partial(submitted, work))

    def wait(self, tasks: list[object], **_options: object) -> tuple[list[object], list[object]]:
        self._reach("wait")
        return tasks[:1], tasks[1:]

    def get(self, task: tuple[Callable[[bytes], bytes], bytes]) -> bytes:
        self._reach("get")
        self.left -= 1
        return task[0](task[1])

    def shutdown(self) -> None:
        self._reach("shutdown")

    def _reach(self, call: str) -> None:
        if call == self.at and (self.left <= 0 or call == "init"):
            raise self.error


LOST = {"remote": RuntimeError("lost"), "wait": ConnectionError("lost"), "get": OSError("lost")}
ENDS = {"init": (ConnectionError("lost"), 2), "shutdown": (ConnectionError("lost"), 0)}


@pytest.mark.parametrize("at", [*LOST, *ENDS])
@pytest.mark.parametrize("verb", ["run limit.rv", "coverage limit.rv", "learn"])
def test_the_end_of_a_cluster_is_reported_and_the_same_command_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: str, at: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("limit.rv").write_text(SPECIFICATION)
    Path("bags").mkdir()
    for seed in range(4):
        make_bag(Path("bags", f"{seed}.bag"), seed)
    undisturbed = rosmop(f"{verb} --bags bags --workers 1")
    error, expected = ENDS.get(at) or (LOST[at], 2)
    monkeypatch.setitem(sys.modules, "ray", _Ray(at, error, 2))
    status, out, err = rosmop(f"{verb} --bags bags --on ray://head:1")
    assert (status, "lost" in err, "add --resume FILE" in err) == (expected, expected == 2, at in LOST)
    assert expected or (status, out, err) == undisturbed
    monkeypatch.setitem(sys.modules, "ray", _Ray(at, error, 2))
    status, _out, err = rosmop(f"{verb} --bags bags --on ray://head:1 --resume journal")
    assert (status, "journal has what is finished" in err) == (expected, at in LOST)
    assert rosmop(f"{verb} --bags bags --workers 1 --resume journal") == undisturbed


def test_a_recording_that_does_not_fit_hides_no_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    good = [make_bag(Path(f"{seed}.bag"), seed) for seed in range(2)]
    other = make_bag(Path("other.bag"), 3, kind="std_msgs/UInt32")
    Path("damaged.bag").write_bytes(good[0].read_bytes()[:-500])
    Path("empty.bag").write_bytes(b"")
    program = CommandContext("rosrv monitor", Path.write_bytes)
    specifications = Specifications({"limit.rv": SPECIFICATION}, {})
    for bad in (other, Path("damaged.bag"), Path("empty.bag")):
        for place in range(3):
            bags = [*good[:place], bad, *good[place:]]
            report = ReplayReport(1, as_json=True)
            spans = [(bag.name, bag, EVER) for bag in bags]
            status = run_spans(program, specifications, spans, report, ["*"], own="/rosrv", margins=False)
            rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
            ended = {row["bag"]: "error" in row for row in rows if row["kind"] == "recording"}
            assert (status, ended) == (3, {bag.name: bag == bad for bag in bags})
