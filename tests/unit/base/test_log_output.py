import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.base.clock import now
from appliance.base.engine_thread import Drive, Driver, InCaller, Turn
from appliance.base.log_output import MAX_WAITING, LogOutput, keep_from_blocking


def by_hand(started: list[InCaller]) -> Drive:
    """Return what starts no thread: a test calls the turns of an output."""

    def drive(name: str, turn: Turn, gather: float) -> Driver:
        started.append(InCaller(name, turn, gather))
        return started[-1]

    return drive


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    """A pipe whose reader does not read, with both descriptors."""
    reader, writer = os.pipe()
    keep_from_blocking(writer)
    os.set_blocking(reader, False)
    yield reader, writer
    for descriptor in (reader, writer):
        os.close(descriptor)


def lost(lines: int, _since: str) -> str:
    return f"{lines} lost\n"


def read(reader: int) -> str:
    return os.read(reader, 1 << 20).decode()


def test_lines_wait_for_a_reader_in_their_order(pipe: tuple[int, int]) -> None:
    reader, writer = pipe
    retries: list[InCaller] = []
    output = LogOutput(writer, lost, by_hand(retries))
    lines = [f"{number:>999}\n" for number in range(200)]
    for line in lines:
        assert output.write(line) == 1000
    found = read(reader)
    assert len(found) < 200_000
    for _ in range(4):
        retries[0].hurry()
        found += read(reader) if found != "".join(lines) else ""
    assert found == "".join(lines)
    assert len(retries) == 1
    assert retries[0].due is None, "no thread is left"


def test_lost_lines_are_counted_and_reported_after_those_that_waited(pipe: tuple[int, int]) -> None:
    reader, writer = pipe
    output = LogOutput(writer, lost, by_hand([]))
    for number in range(1000):
        output.write(f"{number:>999}\n")
    found = ""
    while "lost" not in found:
        found += read(reader)
        output.flush()
    output.write("after\n")
    found += read(reader)
    *kept, report, after = found.splitlines()
    assert after == "after"
    assert report == f"{1000 - len(kept)} lost"
    assert [int(line) for line in kept] == list(range(len(kept)))
    assert MAX_WAITING // 1000 <= len(kept) < 1000


@pytest.mark.parametrize("kind", ["full", "no reader", "closed"])
def test_an_output_that_fails_raises_nothing_and_works_again(tmp_path: Path, kind: str) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    if kind == "full":
        os.dup2(full := os.open("/dev/full", os.O_WRONLY), writer)
        os.close(full)
    elif kind == "closed":
        os.close(writer)
    retries: list[InCaller] = []
    output = LogOutput(writer, lost, by_hand(retries))
    output.write("one \ud800\n")
    output.flush()
    free = os.open(tmp_path / "log", os.O_WRONLY | os.O_CREAT)
    os.dup2(free, writer)
    retries[0].hurry()
    output.write("two\n")
    assert (tmp_path / "log").read_text() == "one \\ud800\ntwo\n"
    for descriptor in {free, writer}:
        os.close(descriptor)


def test_without_another_thread_the_next_line_tries_it_again(pipe: tuple[int, int]) -> None:
    reader, writer = pipe

    def none(_name: str, _turn: Turn, _gather: float) -> Driver:
        raise RuntimeError("can't start new thread")

    output = LogOutput(writer, lost, none)
    output.write("x" * 70_000 + "\n")
    output.write("two\n")
    assert set(read(reader)) == {"x"}
    output.write("three\n")
    assert read(reader).endswith("x\ntwo\nthree\n")


def test_other_programs_with_the_same_terminal_or_pipe_still_block() -> None:
    reader, writer = os.pipe()
    shared = os.dup(writer)
    keep_from_blocking(writer)
    assert (os.get_blocking(writer), os.get_blocking(shared)) == (False, True)
    for descriptor in (reader, writer, shared):
        os.close(descriptor)


def test_a_turn_gives_the_time_of_the_next_one(pipe: tuple[int, int]) -> None:
    _reader, writer = pipe
    retries: list[InCaller] = []
    LogOutput(writer, lost, by_hand(retries)).write("x" * 70_000)
    begun = now()
    retries[0].hurry()
    assert retries[0].due == pytest.approx(begun + 0.5, abs=0.2)
