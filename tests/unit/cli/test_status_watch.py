import codecs
import contextlib
import fcntl
import json
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.channel.answers.status import Status
from tests.support.answers import example
from tests.support.fake_appliance import TOKEN, FakeAppliance
from tests.support.waiting import eventually

pytestmark = pytest.mark.nightly

_LIMIT_SECONDS = 60
_SERVED = {
    "version": "1.2.3", "since": 1.0, "isolation": "container", "probe": "passed", "rosmaster": "reachable",
    "relay": "connected",
}  # fmt: skip


def watch(*options: str, terminal: int | None = None) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "appliance.cli.main", "status", "--watch", *options]
    ours = ("ROS", "COLUMNS", "LINES")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(ours)}
    output = subprocess.PIPE if terminal is None else terminal
    environment |= {"TERM": "xterm", "ROSRV_TOKEN": TOKEN}
    return subprocess.Popen(command, env=environment, stdin=terminal, stdout=output, stderr=output)


@pytest.fixture
def serving(tmp_path: Path) -> Iterator[Callable[..., FakeAppliance]]:
    with contextlib.ExitStack() as ends:

        def serve(**status: Any) -> FakeAppliance:
            (tmp_path / "admin.sock").unlink(missing_ok=True)
            fake = ends.enter_context(FakeAppliance())
            fake.answer("status", **_SERVED | status)
            fake.serve(tmp_path)
            return fake

        yield serve


class Terminal:
    def __init__(self, columns: int, lines: int, state: Path, seconds: str) -> None:
        self._ours, theirs = pty.openpty()
        self._size(columns, lines)
        self.process = watch("--every", f"{seconds}s", "--state", str(state), terminal=theirs)
        os.close(theirs)
        self.shown = ""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _size(self, columns: int, lines: int) -> None:
        fcntl.ioctl(self._ours, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))

    def _read(self) -> None:
        decoder = codecs.getincrementaldecoder("utf-8")()  # a part may end within a character
        with contextlib.suppress(OSError):  # the terminal closes with the command
            while part := os.read(self._ours, 65_536):
                self.shown += decoder.decode(part)

    def resize(self, columns: int, lines: int) -> None:
        self._size(columns, lines)
        self.process.send_signal(signal.SIGWINCH)

    def until(self, text: str, after: int = 0) -> int:
        eventually(lambda: text in self.shown[after:], lambda: f"{text!r} in {self.shown[after:]!r}")
        return self.shown.index(text, after) + len(text)

    def interrupted(self) -> int:
        return self.ended_by(signal.SIGINT)

    def ended_by(self, number: signal.Signals) -> int:
        self.process.send_signal(number)
        status = self.process.wait(_LIMIT_SECONDS)
        self._reader.join(_LIMIT_SECONDS)
        os.close(self._ours)
        return status


@pytest.fixture
def terminal(tmp_path: Path) -> Iterator[Callable[..., Terminal]]:
    opened: list[Terminal] = []

    def start(columns: int, lines: int, seconds: str = "1") -> Terminal:
        opened.append(Terminal(columns, lines, tmp_path, seconds))
        return opened[-1]

    yield start
    for one in opened:
        if one.process.poll() is None:
            one.process.kill()
            one.process.wait(_LIMIT_SECONDS)


def test_a_terminal_is_redrawn_in_place(
    serving: Callable[..., FakeAppliance], terminal: Callable[..., Terminal]
) -> None:
    fake = serving()
    shown = terminal(80, 30)
    shown.until("1.2.3")
    fake.answer("status", **_SERVED, nodes=7)
    shown.until("7 nodes")
    assert shown.interrupted() == 0
    frames, _, left = shown.shown.partition("\x1b[?1049l")
    assert frames.count("\x1b[?1049h") == 1
    assert "\x1b[2J" not in frames.partition("1.2.3")[2]
    assert all(frame.count("\n") < 30 for frame in frames.split("\x1b[H"))
    assert "7 nodes" in left
    assert "Ctrl-C" not in left


def test_a_terminated_watch_restores_the_terminal(
    serving: Callable[..., FakeAppliance], terminal: Callable[..., Terminal]
) -> None:
    serving()
    shown = terminal(80, 30)
    shown.until("1.2.3")
    assert shown.ended_by(signal.SIGTERM) == 0
    assert "\x1b[?25h" in shown.shown
    assert "1.2.3" in shown.shown.partition("\x1b[?1049l")[2]


def test_an_appliance_that_is_away_is_awaited(
    serving: Callable[..., FakeAppliance], terminal: Callable[..., Terminal]
) -> None:
    shown = terminal(100, 30)
    shown.until("not running since ")
    since = re.search(r"since (\d\d:\d\d:\d\dZ): ", shown.shown)
    assert since is not None
    shown.until("\x1b[H", shown.until(since[1]))
    assert {*re.findall(r"since (\d\d:\d\d:\d\dZ): ", shown.shown)} == {since[1]}
    serving(audit={"failed": "the disk is full"})
    shown.until("the disk is full")
    assert shown.interrupted() == 1


def test_a_pipe_gets_one_status_after_the_other(
    serving: Callable[..., FakeAppliance], tmp_path: Path
) -> None:
    serving()
    with watch("--every", "1s", "--state", str(tmp_path)) as process:
        assert process.stdout is not None
        lines: list[bytes] = []
        while sum(line.startswith(b"appliance") for line in lines) < 2:
            lines.append(process.stdout.readline())
        process.stdout.close()
        assert process.wait(_LIMIT_SECONDS) == 0
        assert process.stderr is not None
        assert process.stderr.read() == b""
    assert lines.count(b"\n") == 1
    assert lines[lines.index(b"\n") + 1] == lines[-1]
    assert not any(b"\x1b" in line for line in lines)


def test_with_json_each_line_is_an_object(serving: Callable[..., FakeAppliance], tmp_path: Path) -> None:
    with watch("--every", "1s", "--json", "--state", str(tmp_path)) as process:
        assert process.stdout is not None
        away = json.loads(process.stdout.readline())
        again = json.loads(process.stdout.readline())
        serving()
        found = again
        while "version" not in found:
            found = json.loads(process.stdout.readline())
        process.send_signal(signal.SIGINT)
        assert process.wait(_LIMIT_SECONDS) == 0
    assert away == again
    assert sorted(away) == ["error", "not_running_since"]
    assert (found["version"], found["troubles"]) == ("1.2.3", [])


def test_a_rejected_token_ends_the_watch() -> None:
    """Each further request would be one more denial in the audit log."""
    with FakeAppliance() as fake:
        fake.problem(401, "not-recognised", "the token is wrong or revoked")
        with watch("--every", "1s", "--api", fake.url) as process:
            assert process.wait(_LIMIT_SECONDS) == 2
            assert process.stderr is not None
            assert b"is not accepted: the token is wrong or revoked" in process.stderr.read()
        assert len(fake.requests) == 1


def test_a_restarted_api_may_reject_a_token_for_a_moment() -> None:
    good = msgspec.json.encode(example(Status, **_SERVED))
    with FakeAppliance() as fake:
        fake.body = good
        with watch("--every", "1s", "--json", "--api", fake.url) as process:
            assert process.stdout is not None
            for served in (True, False, True):
                if served:
                    fake.status, fake.body = 200, good
                else:
                    fake.problem(401, "not-recognised", "the token is wrong or revoked")
                while ("version" in json.loads(process.stdout.readline())) != served:
                    pass
            fake.problem(401, "not-recognised", "the token is wrong or revoked")
            last = [json.loads(line) for line in process.stdout]
            assert process.wait(_LIMIT_SECONDS) == 2
    assert [one for one in last if "version" not in one] == last[-2:]
