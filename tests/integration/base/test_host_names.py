"""Names that other hosts chose are resolved in a bounded time, this machine's own first."""

import socket
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from appliance.base import host_names
from appliance.base.host_names import addresses_of

pytestmark = pytest.mark.nightly

HOSTILE = [f"a{number}.stranger.invalid" for number in range(500)]


class SlowServer:
    """Takes the place of `getent`: it answers for some names at once, and for all others never."""

    def __init__(self, known: dict[str, str]) -> None:
        self.known, self.asked = known, list[str]()

    def __call__(self, command: list[str], /, **_options: object) -> Any:
        self.asked.append(command[-1])
        return _Answer(command, self.known.get(command[-1]))


class _Answer:
    def __init__(self, command: list[str], address: str | None) -> None:
        self._command, self._address = command, address

    def __enter__(self) -> "_Answer":
        return self

    def __exit__(self, *_exc: object) -> None: ...

    def communicate(self, timeout: float) -> tuple[str, None]:
        if self._address is None:
            threading.Event().wait(timeout)
            raise subprocess.TimeoutExpired(self._command, timeout)
        return f"{self._address} STREAM\n{self._address} DGRAM\n", None

    def kill(self) -> None: ...


@pytest.fixture(autouse=True)
def hosts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "hosts"
    file.write_text("127.0.0.1 localhost\n192.168.50.2 nuc Nuc2 # a note\nnonsense nuc\n::1 localhost\n")
    monkeypatch.setattr(host_names, "_FILE", file)
    monkeypatch.setattr(host_names, "_NAME_SECONDS", 0.1)
    monkeypatch.setattr(host_names, "_WHOLE_SECONDS", 0.3)


def test_names_of_a_slow_server_keep_neither_listed_names_nor_the_own_one_waiting() -> None:
    own = f"{socket.gethostname().partition('.')[0]}.local"
    server, began = SlowServer({own: "192.168.50.1"}), time.monotonic()
    found = addresses_of([*HOSTILE, "%s", "-x", "nuc", "NUC2", "localhost", own], server)
    assert time.monotonic() - began < 5
    assert (found["nuc"], found["NUC2"]) == (["192.168.50.2"], ["192.168.50.2"])
    assert found["localhost"] == ["127.0.0.1", "::1"]
    assert found[own] == ["192.168.50.1"]
    assert server.asked[0] == own
    assert not found[HOSTILE[0]]
    assert "%s" not in server.asked


def test_names_are_asked_for_in_the_given_order() -> None:
    server = SlowServer({"second.example": "192.168.50.3"})
    assert addresses_of(["second.example", *HOSTILE], server)["second.example"] == ["192.168.50.3"]
