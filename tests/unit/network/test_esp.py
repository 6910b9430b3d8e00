"""Tests of finding out where ESP can run."""

import subprocess
from pathlib import Path

import pytest

from appliance.network import esp
from appliance.network.namespaces import Namespace, NetworkError


def answers(monkeypatch: pytest.MonkeyPatch, status: int) -> list[list[str]]:
    """Let `ip` end with this status; the commands it was given."""
    given: list[list[str]] = []

    def run(command: list[str], **_options: object) -> "subprocess.CompletedProcess[str]":
        given.append(command)
        return subprocess.CompletedProcess(command, status, "", "Error: Requested AEAD algorithm not found.")

    monkeypatch.setattr(subprocess, "run", run)
    return given


def test_a_kernel_that_takes_the_cipher_is_used_and_left_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """The state that was tried is taken away again."""
    given = answers(monkeypatch, 0)
    assert esp.choose_esp(Namespace.own()) == "kernel"
    assert [command[3] for command in given] == ["add", "delete"]
    assert given[0][-2:][0].startswith("0x")
    spi = given[0][given[0].index("spi") + 1]
    assert given[1][-1] == spi


def test_without_it_esp_runs_in_user_space(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The TUN device must be there."""
    answers(monkeypatch, 2)
    (tmp_path / "tun").touch()
    monkeypatch.setattr(esp, "TUN", tmp_path / "tun")
    assert esp.choose_esp(Namespace.own()) == "user space"


def test_with_neither_the_message_says_what_to_do(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """It has what the kernel said, and how a container gets the device."""
    answers(monkeypatch, 2)
    monkeypatch.setattr(esp, "TUN", tmp_path / "none")
    with pytest.raises(NetworkError, match=r"AEAD algorithm not found.*--device"):
        esp.choose_esp(Namespace.own())
