"""Run programs that print one JSON object per line. A test waits for the line that it needs, with a limit.

Other lines (stock tools, warnings) are kept as `{"text": line}`. A failure shows the whole output.
"""

import contextlib
import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, Self

Event = dict[str, Any]
# Seconds; generous, as the machine may be busy. A slow machine (an emulated one) asks for more.
LIMIT = 30.0 * float(os.environ.get("TESTS_PATIENCE", "1"))


class Host(Protocol):
    @property
    def address(self) -> str: ...
    def popen(self, args: Sequence[str | os.PathLike[str]], **options: Any) -> "subprocess.Popen[Any]": ...


class ThisMachine:
    address = "127.0.0.1"

    def popen(self, args: Sequence[str | os.PathLike[str]], **options: Any) -> "subprocess.Popen[Any]":
        return subprocess.Popen(list(args), **options)


def runs(pid: int | str) -> bool:
    """Return whether a process runs. One that has ended but was not yet reaped does not run."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):  # the second if it is reaped while it is read
        return False


class Process:
    def __init__(
        self,
        host: Host,
        command: Sequence[str],
        *,
        env: Mapping[str, str],
        label: str,
        cwd: str | None = None,
    ) -> None:
        self.host, self.command, self.label = host, list(command), label
        self.events: list[Event] = []
        self.errors: list[str] = []
        self._changed = threading.Condition()
        self._ended = False
        self._asked = False  # to end
        self.deaf = False  # whether `stop` had to use force
        self.popen = host.popen(
            command,
            env=dict(env),
            cwd=cwd,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="backslashreplace",
            start_new_session=True,
        )
        self._readers = [
            threading.Thread(target=self._read_events, name=f"{label} stdout", daemon=True),
            threading.Thread(target=self._read_errors, name=f"{label} stderr", daemon=True),
        ]
        for reader in reversed(self._readers):  # the first one waits for the second at the end
            reader.start()

    @property
    def pid(self) -> int:
        return int(self.popen.pid)

    @property
    def running(self) -> bool:
        return self.popen.poll() is None

    def wait_for(
        self,
        wanted: Callable[[Event], bool] | None = None,
        *,
        timeout: float = LIMIT,
        since: int = 0,
        **fields: Any,
    ) -> Event:
        def accepts(event: Event) -> bool:
            given = all(event.get(key) == value for key, value in fields.items())
            return given and (wanted is None or wanted(event))

        deadline = time.monotonic() + timeout
        with self._changed:
            looked_at = since
            while True:
                for event in self.events[looked_at:]:
                    if accepts(event):
                        return event
                looked_at = max(since, len(self.events))
                left = deadline - time.monotonic()
                if self._ended or left <= 0:
                    why = "ended" if self._ended else f"{timeout:.0f} s passed"
                    raise AssertionError(f"no such event ({fields or wanted}): {why}\n{self.story()}")
                self._changed.wait(left)

    def wait_for_text(self, text: str, *, timeout: float = LIMIT, since: int = 0) -> str:
        def said(event: Event) -> str:
            return str(event.get("text", event.get("event", "")))

        return said(self.wait_for(lambda event: text in said(event), timeout=timeout, since=since))

    def wait_for_error(self, text: str, *, count: int = 1, timeout: float = LIMIT) -> None:
        with self._changed:
            there = self._changed.wait_for(
                lambda: sum(text in line for line in self.errors) >= count, timeout
            )
        assert there, f"it did not print {text!r} within {timeout:.0f} s\n{self.story()}"

    def wait_for_count(
        self, count: int, *, timeout: float = LIMIT, since: int = 0, **fields: Any
    ) -> list[Event]:
        events: list[Event] = []
        position = since
        deadline = time.monotonic() + timeout
        with self._changed:
            while True:
                for event in self.events[position:]:
                    if all(event.get(key) == value for key, value in fields.items()):
                        events.append(event)
                        deadline = time.monotonic() + timeout
                if len(events) >= count:
                    return events[:count]
                position = max(since, len(self.events))
                left = deadline - time.monotonic()
                if self._ended or left <= 0:
                    why = "ended" if self._ended else f"{timeout:.0f} s passed"
                    raise AssertionError(
                        f"{len(events)} of {count} such events ({fields}): {why}\n{self.story()}"
                    )
                self._changed.wait(left)

    def mark(self) -> int:
        with self._changed:
            return len(self.events)

    def seen(self, **fields: Any) -> list[Event]:
        with self._changed:
            return [event for event in self.events if all(event.get(k) == v for k, v in fields.items())]

    def send(self, line: str) -> None:
        assert self.popen.stdin is not None
        self.popen.stdin.write(line + "\n")
        self.popen.stdin.flush()

    def wait(self, *, timeout: float = LIMIT) -> int:
        try:
            status = self.popen.wait(timeout)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"still running after {timeout:.0f} s\n{self.story()}") from None
        for reader in self._readers:
            reader.join(timeout)
        return int(status)

    def output(self) -> str:
        with self._changed:
            return "\n".join(
                event["text"] if set(event) == {"text"} else json.dumps(event) for event in self.events
            )

    def interrupt(self, with_signal: int = signal.SIGINT) -> None:
        if self.popen.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                self.popen.stdin.close()  # ends a program that waits for its next order
        if self.running:
            self.popen.send_signal(with_signal)
        self._asked = True

    def stop(self, *, with_signal: int = signal.SIGINT, timeout: float = 20) -> int:
        """Send the signal, and if the program does not end SIGABRT (a Python program prints its stack) and SIGKILL."""
        if not self._asked:
            self.interrupt(with_signal)
        if self.running:
            try:
                self.popen.wait(timeout)
            except subprocess.TimeoutExpired:
                self.deaf = True
                self.popen.send_signal(signal.SIGABRT)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self.popen.wait(5)
                self.kill()
        status = int(self.popen.wait(timeout))
        for reader in self._readers:
            reader.join(timeout)
        for stream in (self.popen.stdout, self.popen.stderr):
            if stream is not None and not stream.closed:
                stream.close()
        return status

    def kill(self) -> None:
        if self.running:
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.killpg(self.popen.pid, signal.SIGKILL)
        self.popen.wait(LIMIT)

    def story(self) -> str:
        with self._changed:
            events = [json.dumps(event) for event in self.events[-40:]]
            errors = self.errors[-40:]
        state = "running" if self.running else f"ended with {self.popen.returncode}"
        lines = [f"--- {self.label} on {self.host.address} ({state}): {' '.join(self.command)}", *events]
        return "\n".join([*lines, *(f"stderr: {line}" for line in errors)])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()

    def _read_events(self) -> None:
        assert self.popen.stdout is not None
        for line in self.popen.stdout:
            with self._changed:
                self.events.append(_event(line.rstrip("\n")))
                self._changed.notify_all()
        self._readers[1].join(5)  # the reason for the end is on standard error
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _read_errors(self) -> None:
        assert self.popen.stderr is not None
        for line in self.popen.stderr:
            with self._changed:
                self.errors.append(line.rstrip("\n"))
                self._changed.notify_all()


def _event(line: str) -> Event:
    if line.startswith("{"):
        try:
            parsed = json.loads(line)
        except ValueError:
            return {"text": line}
        if isinstance(parsed, dict):
            return parsed
    return {"text": line}
