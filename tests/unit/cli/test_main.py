import errno

import pytest

from appliance.cli import main
from appliance.configuration.config_sources import ConfigError, Mistake
from appliance.network.namespaces import NetworkError
from appliance.supervisor.errors import StartError


@pytest.mark.parametrize(
    "error",
    [
        StartError("port 1 is in use"),
        NetworkError("port 1 is in use"),
        ConfigError([Mistake("a:1", "port 1 is in use")]),
    ],
)
def test_a_users_error_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: Exception
) -> None:
    assert outcome(monkeypatch, error) == 1
    said = capsys.readouterr().err
    assert said.startswith("rosrv: ")
    assert said.endswith("port 1 is in use\n")
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (PermissionError(errno.EACCES, "Permission denied", "/var/lib/rosrv/x"),
         "rosrv: /var/lib/rosrv/x: Permission denied; run this as root\n"),
        (OSError(errno.ENOSPC, "No space left on device", "/a b"),
         "rosrv: /a b: No space left on device; free some space, or name another disk\n"),
        (OSError(errno.ENOSPC, "No space left on device"),
         "rosrv: output: No space left on device; free some space, or name another disk\n"),
    ],
)  # fmt: skip
def test_a_lack_of_rights_or_space_is_not_called_a_defect(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: OSError, said: str
) -> None:
    assert outcome(monkeypatch, error) == 2
    assert capsys.readouterr().err == said


def test_a_defect_is_reported_with_its_position(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert outcome(monkeypatch, ZeroDivisionError("odd")) == 70
    said = capsys.readouterr().err
    assert "please report it: ZeroDivisionError: odd (" in said
    assert "test_main.py:" in said
    assert "Traceback" not in said


def outcome(monkeypatch: pytest.MonkeyPatch, error: Exception) -> object:
    def fail() -> None:
        raise error

    monkeypatch.setattr(main, "app", fail)
    with pytest.raises(SystemExit) as ended:
        main.main()
    return ended.value.code
