import errno
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

from appliance.network import esp
from appliance.network.namespaces import Namespace, NetworkError
from tests.support.requirements import need_root

pytestmark = pytest.mark.nightly


def answers(monkeypatch: pytest.MonkeyPatch, status: int) -> list[list[str]]:
    given: list[list[str]] = []

    def run(command: list[str], **_options: object) -> "subprocess.CompletedProcess[str]":
        given.append(command)
        return subprocess.CompletedProcess(command, status, "", "Error: Requested AEAD algorithm not found.")

    monkeypatch.setattr(subprocess, "run", run)
    return given


def test_a_kernel_that_takes_the_cipher_is_used_and_left_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    given = answers(monkeypatch, 0)
    assert esp.choose_esp(Namespace.own()) == "kernel"
    assert [command[3] for command in given] == ["add", "delete"]
    assert given[0][-2:][0].startswith("0x")
    spi = given[0][given[0].index("spi") + 1]
    assert given[1][-1] == spi


def test_the_device_is_lent_to_one_user(tmp_path: Path) -> None:
    need_root()
    place = Path(tempfile.mkdtemp(dir="/dev/shm"))
    try:
        place.chmod(0o755)
        device = place / "tun"
        device.touch(0o600)
        device.chmod(0o600)
        for uid in (61016, 61016, 61099):  # also a second time, and for another user
            esp.lend_tun(uid, uid, device)
            assert _opens(uid, device)
        assert _opens(61016, device)
        assert not _opens(61017, device)
        assert device.stat().st_mode & 0o007 == 0
        open_to_all = place / "open"
        open_to_all.touch()
        open_to_all.chmod(0o666)
        esp.lend_tun(61016, 61016, open_to_all)
        assert "system.posix_acl_access" not in os.listxattr(open_to_all)
    finally:
        shutil.rmtree(place)


def test_a_device_that_cannot_be_lent_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "tun").touch(0o600)

    def refuse(*_arguments: object) -> None:
        raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))

    monkeypatch.setattr(os, "setxattr", refuse)
    with pytest.raises(NetworkError, match=r"may not open .*tun \(mode 0600\).* chgrp 7 .* chmod 0660"):
        esp.lend_tun(7, 7, tmp_path / "tun")
    with pytest.raises(NetworkError, match="No such file"):
        esp.lend_tun(7, 7, tmp_path / "none")


def _opens(uid: int, path: Path) -> bool:
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.setgroups([])
            os.setresgid(uid, uid, uid)
            os.setresuid(uid, uid, uid)
            os.open(path, os.O_RDWR)
            status = 0
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_without_it_esp_runs_in_user_space(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    answers(monkeypatch, 2)
    (tmp_path / "tun").touch()
    monkeypatch.setattr(esp, "TUN", tmp_path / "tun")
    assert esp.choose_esp(Namespace.own()) == "user space"


def test_with_neither_the_message_says_what_to_do(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    answers(monkeypatch, 2)
    monkeypatch.setattr(esp, "TUN", tmp_path / "none")
    with pytest.raises(NetworkError, match=r"AEAD algorithm not found.*--device"):
        esp.choose_esp(Namespace.own())
