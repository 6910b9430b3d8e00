import json
from pathlib import Path

import pytest

from appliance.features.standby.witness.lease_file import LeaseFile, LeaseRecord
from appliance.features.standby.witness.program import main
from tests.unit.features.standby.witness.robot import BOTH


@pytest.fixture
def settings(tmp_path: Path) -> Path:
    path = tmp_path / "witness.json"
    appliances = {
        "a": {"address": "10.0.0.2", "key": "aa" * 32},
        "b": {"address": "10.0.0.3", "key": "bb" * 32},
    }
    given = {"listen": "10.0.0.1:7411", "fixed": "10.0.0.100", "ports": ["11311", "20000-20999"]}
    state = str(tmp_path / "state/lease")
    path.write_text(json.dumps({**given, "appliances": appliances, "state": state}))
    path.chmod(0o600)
    return path


def test_begin_writes_a_lease_with_a_greater_epoch(
    settings: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["begin", "--settings", str(settings)]
    assert main([*command, "--in-sync", "a,b", "--epoch", "5"]) == 0
    file = LeaseFile(str(settings.parent / "state/lease"), BOTH)
    assert file.read() == LeaseRecord(5, "", BOTH, "")
    for wrong, option in (("a 5", "--epoch"), ("c 9", "--in-sync"), (" 9", "--in-sync"), ("a -1", "--epoch")):
        names, epoch = wrong.split(" ")
        assert main([*command, f"--in-sync={names}", f"--epoch={epoch}"]) == 1
        assert capsys.readouterr().err.startswith(f"witness.py: {option}: ")
    assert file.read().epoch == 5


def test_begin_waits_until_the_witness_is_stopped(settings: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A running witness would write its own lease again."""
    with LeaseFile(str(settings.parent / "state/lease"), BOTH):
        assert main(["begin", "--settings", str(settings), "--in-sync", "a", "--epoch", "5"]) == 1
    assert "systemctl stop rosrv-witness" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('"aa', '"bb', "a key of its own"),
        ("10.0.0.3", "10.0.0.2", "different addresses"),
        ("10.0.0.3", "127.0.0.1", "cannot be an address"),
        ("10.0.0.3", "fd00::1", "fd00::1"),
        ('"aaaa', '"zzaa', "64 hexadecimal digits"),
        ('"11311"', '"0"', "not a port or a range"),
        ('"11311", "20000-20999"', "", "ports is empty"),
        ('"fixed"', '"fix"', "'fixed' is missing"),
        ('"a"', '"../a"', "is not valid"),
        ("{", "", ""),
    ],
)
def test_wrong_settings_are_rejected_with_the_reason(
    settings: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, reason: str
) -> None:
    text = settings.read_text()
    changed = text.replace(old, new)
    if old == '"aa':
        changed = text.replace("aa" * 32, "bb" * 32)
    settings.write_text(changed)
    assert main(["shut", "--settings", str(settings)]) == 1
    error = capsys.readouterr().err
    assert f"the settings {settings} cannot be used: " in error and reason in error


def test_keys_that_others_can_read_are_rejected(settings: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings.chmod(0o640)
    assert main(["serve", "--settings", str(settings)]) == 1
    assert f"chmod 600 {settings}" in capsys.readouterr().err
