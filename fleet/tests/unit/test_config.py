import errno
import os
from pathlib import Path

import pytest
from rosrv_fleet import cli
from rosrv_fleet.config import FleetConfigError, load_config
from typer.testing import CliRunner

from tests.support.sources import ROOT


def test_the_example_is_valid() -> None:
    config = load_config(ROOT / "fleet/fleet.example.yaml")
    assert config.certificate == Path("/var/lib/rosrv-fleet/server.pem")
    assert config.address == ("0.0.0.0", 8444)


def test_paths_are_relative_to_the_file(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text("data: here\n")
    assert load_config(file).key == tmp_path / "here/server.key"
    file.write_text("data: here\ncertificate: own.pem\nkey: own.key\n")
    assert load_config(file).certificate == tmp_path / "own.pem"


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "Expected `object`"),
        ("certificate: a", "missing required field `key`"),
        ("certificate: a\nkey: b\nlisten: x", "listen|invalid literal"),
        ("certificate: a\nkey: b\nlisten: h:99999", "no valid port"),
        ("certificate: a\nkey: b\ntypo: 1", "typo"),
        ("certificate: a\nkey: b\nlimits: {uploads: 0}", "limits.uploads"),
        ("certificate: a\nkey: b\nevidence: {bundle_bytes: 0}", "evidence.bundle_bytes"),
        ("certificate: [a]\nkey: b", "path"),
        (":", "fleet.yaml"),
    ],
)
def test_a_wrong_configuration_is_refused(text: str, why: str, tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(text)
    with pytest.raises(FleetConfigError, match=why) as error:
        load_config(file)
    assert str(file) in str(error.value)


@pytest.mark.parametrize(("seconds", "warned"), [(60, True), (120, False)])
def test_a_silence_shorter_than_two_reports_is_warned_about(
    seconds: int, warned: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    served = []
    monkeypatch.setattr(cli, "make_collector", lambda config: config)
    monkeypatch.setattr(cli, "serve", lambda config: served.append(config.silent_seconds))
    file = tmp_path / "fleet.yaml"
    file.write_text(f"data: here\nsilent_seconds: {seconds}\n")
    done = CliRunner().invoke(cli.app, ["serve", "--config", str(file)])
    assert (served, "set at least 120" in done.output) == ([seconds], warned)


def test_an_unreadable_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "fleet.yaml"

    def refuse(_path: Path, encoding: str | None = None) -> str:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "read_text", refuse)
    monkeypatch.setattr(os, "geteuid", lambda: 61030)
    with pytest.raises(FleetConfigError, match=r"denied; let user 61030 read it, .* chmod 644 fleet.yaml"):
        load_config(file)
