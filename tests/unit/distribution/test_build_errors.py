"""A build that cannot succeed ends with a sentence and a remedy."""

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    PrivateFormat,
)

from distribution import deb, image, release, site

Main = Callable[[list[str]], int]
_TOOLS = [pytest.param(image.main, [], id="image"), pytest.param(image.main, ["lock", "base"], id="lock")]
_TOOLS += [pytest.param(site.main, [], id="site"), pytest.param(deb.main, ["amd64"], id="package")]


@pytest.fixture(autouse=True)
def package_in_an_own_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(deb, "ROOT", tmp_path)
    for step in ("_missing_packages", "_gather", "_debian_folder"):
        monkeypatch.setattr(deb, step, lambda *_given: [])


@pytest.mark.parametrize(("main", "arguments"), _TOOLS)
def test_a_missing_program(
    main: Main, arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*_given: object, **_options: object) -> None:
        raise FileNotFoundError

    monkeypatch.setattr(subprocess, "run", run)
    assert main(arguments) == 1
    assert ": sudo apt-get install " in capsys.readouterr().err


@pytest.mark.parametrize(("main", "arguments"), _TOOLS)
def test_a_program_that_fails(
    main: Main, arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(command: list[str], **_options: Any) -> subprocess.CompletedProcess[str]:
        git = command[0] == "git"  # of which the time of the commit is asked
        return subprocess.CompletedProcess(command, 0 if git else 7, "1700000000" if git else "", "no space")

    monkeypatch.setattr(subprocess, "run", run)
    assert main(arguments) == 1
    assert "ended with status 7: no space; " in capsys.readouterr().err


def test_the_base_of_a_lock_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["lock"], ["lock", "--quiet"]):
        assert image.main(arguments) == 2
        assert "lock BASE" in capsys.readouterr().err


def test_a_key_that_cannot_sign(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key, encryption = ec.generate_private_key(ec.SECP256R1()), BestAvailableEncryption(b"a passphrase")
    encrypted, other, absent = tmp_path / "encrypted.pem", tmp_path / "other.pem", tmp_path / "absent.pem"
    encrypted.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, encryption))
    other.write_text("a file\n")
    for file, reason in (
        (encrypted, "is encrypted: give a key without a passphrase (openssl pkey"),
        (other, "is not a private key (openssl ecparam"),
        (absent, "No such file"),
    ):
        assert release.main([str(file)]) == 1
        text = capsys.readouterr().err
        assert reason in text and str(file) in text
