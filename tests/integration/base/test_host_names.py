"""Names that other hosts chose are resolved in a bounded time, this machine's own first."""

import socket
import subprocess
import time
from pathlib import Path

import pytest

from appliance.base import host_names
from appliance.base.host_names import Starter, addresses_of

pytestmark = pytest.mark.nightly

HOSTILE = [f"a{number}.stranger.invalid" for number in range(500)]


def slow_server(known: dict[str, str], asked: list[str]) -> Starter:
    """Take the place of `getent`: it answers for some names at once, and for all others not in time."""

    def start(command: list[str], /, *, stdout: int, stderr: int, text: bool) -> "subprocess.Popen[str]":
        name = command[-1]
        asked.append(name)
        instead = ["echo", f"{known[name]} STREAM"] if name in known else ["sleep", "9"]
        return subprocess.Popen(instead, stdout=stdout, stderr=stderr, text=text)

    return start


@pytest.fixture(autouse=True)
def hosts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "hosts"
    file.write_text("127.0.0.1 localhost\n192.168.50.2 nuc Nuc2 # a note\nnonsense nuc\n::1 localhost\n")
    monkeypatch.setattr(host_names, "_FILE", file)
    monkeypatch.setattr(host_names, "_NAME_SECONDS", 0.5)
    monkeypatch.setattr(host_names, "_WHOLE_SECONDS", 1.0)


def test_names_of_a_slow_server_keep_neither_listed_names_nor_the_own_one_waiting() -> None:
    own = f"{socket.gethostname().partition('.')[0]}.local"
    asked, began = list[str](), time.monotonic()
    server = slow_server({own: "192.168.50.1"}, asked)
    found = addresses_of([*HOSTILE, "%s", "-x", "nuc", "NUC2", "localhost", own], server)
    assert time.monotonic() - began < 5
    assert (found["nuc"], found["NUC2"]) == (["192.168.50.2"], ["192.168.50.2"])
    assert found["localhost"] == ["127.0.0.1", "::1"]
    assert found[own] == ["192.168.50.1"]
    assert asked[0] == own
    assert not found[HOSTILE[0]]
    assert "%s" not in asked


def test_names_are_asked_for_in_the_given_order() -> None:
    server = slow_server({"second.example": "192.168.50.3"}, [])
    assert addresses_of(["second.example", *HOSTILE], server)["second.example"] == ["192.168.50.3"]
