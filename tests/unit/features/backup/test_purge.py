import errno
import os
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from appliance.backup.contents import BackupError
from appliance.cli.main import app
from appliance.features.backup.purge import purge
from appliance.supervisor.state_directory import StateDirectory

KEY = b"-----BEGIN PRIVATE KEY-----"


@pytest.fixture
def state(tmp_path: Path) -> Path:
    place = tmp_path / "state"
    StateDirectory(place).close()
    (place / "signer").mkdir()
    (place / "signer" / "audit.key").write_bytes(KEY)
    (place / "control").mkdir()
    (place / "control" / "audit.db").write_bytes(b"x" * (1 << 20))
    outside = tmp_path / "mine"
    outside.write_bytes(KEY)
    (place / "control" / "link").symlink_to(outside)
    os.link(outside, place / "control" / "second")
    return place


def test_all_of_it_is_removed_and_nothing_else(state: Path, tmp_path: Path) -> None:
    with (state / "signer" / "audit.key").open("rb") as still:
        files, written = purge(state)
        kept = still.read()
    assert kept != KEY
    assert len(kept) == len(KEY)
    assert (files, written) == (5, 2)  # including the lock
    assert not state.exists()
    assert (tmp_path / "mine").read_bytes() == KEY


@pytest.mark.parametrize("number", [errno.EBUSY, errno.EROFS, errno.EACCES])
def test_a_mount_point_stays_empty(state: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """The volume of a container, or an encrypted partition."""
    kept(state, monkeypatch, number)
    done = CliRunner().invoke(app, ["purge", "--state", str(state), "--yes"])
    assert (done.exit_code, "is erased: 5 files" in done.output) == (0, True)
    assert list(state.iterdir()) == []


def test_new_files_are_reported(state: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept(state, monkeypatch, errno.ENOTEMPTY)
    with pytest.raises(BackupError, match="it has new files; run this again"):
        purge(state)


def kept(state: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    remove = os.rmdir

    def refused(path: Path, **options: Any) -> None:
        if path == state:
            raise OSError(number, os.strerror(number), str(path))
        remove(path, **options)

    monkeypatch.setattr(os, "rmdir", refused)


def test_not_while_an_appliance_uses_it(state: Path) -> None:
    held = StateDirectory(state)
    try:
        with pytest.raises(BackupError, match=f"appliance .process {os.getpid()}.* already uses the state"):
            purge(state)
    finally:
        held.close()
    assert (state / "signer" / "audit.key").read_bytes() == KEY


def test_only_a_state_directory_is_removed(tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    for place, why in (
        (tmp_path / "home", "empty"),
        (tmp_path / "nothing", "the state directory .* does not exist"),
    ):
        with pytest.raises(BackupError, match=why):
            purge(place)
    (tmp_path / "home" / "letter").write_text("dear")
    with pytest.raises(BackupError, match="is not the state directory of an appliance"):
        purge(tmp_path / "home")
    assert (tmp_path / "home" / "letter").exists()


def test_yes_needs_the_state_directory_beside_it(state: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROSRV_STATE", str(state))
    done = CliRunner().invoke(app, ["purge", "--yes"])
    assert (done.exit_code, f"--yes needs the directory: --state {state}" in done.output) == (2, True)
    assert state.is_dir()


def test_the_command_asks_for_the_path_again(state: Path) -> None:
    run = CliRunner().invoke
    refused = run(app, ["purge", "--state", str(state)], input="/var/lib/rosrv\n")
    assert (refused.exit_code, "nothing was changed" in refused.output) == (1, True)
    done = run(app, ["purge", "--state", str(state)], input=f"{state}\n")
    assert (done.exit_code, "is erased: 5 files" in done.output) == (0, True)
    assert not state.exists()


def test_another_folder_is_refused_before_the_question(tmp_path: Path) -> None:
    (tmp_path / "passwd").write_text("root")
    answer = CliRunner().invoke(app, ["purge", "--state", str(tmp_path)], input=f"{tmp_path}\n")
    assert answer.exit_code == 1
    assert "This erases" not in answer.output
    assert (tmp_path / "passwd").exists()


def test_an_unreadable_place_is_an_error_with_advice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def is_dir(_path: Path) -> bool:
        raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path))

    monkeypatch.setattr(Path, "is_dir", is_dir)
    answer = CliRunner().invoke(app, ["purge", "--state", str(tmp_path)])
    assert answer.exit_code == 1
    assert "run this as root" in answer.output
