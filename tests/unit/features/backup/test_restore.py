import os
import stat
from pathlib import Path

import pytest

from appliance.backup.contents import BackupError
from appliance.features.backup import restore as backup_restore
from appliance.features.backup.restore import restore
from appliance.supervisor.errors import StartError
from appliance.supervisor.restore_mark import refuse_half_restored
from appliance.supervisor.state_directory import foreign
from tests.support.backups import LOG, archive, header
from tests.support.requirements import need_root


def test_a_backup_larger_than_the_disk_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = archive(tmp_path / "bomb", header("api/x", 1 << 24), bytes(1 << 24))
    assert file.stat().st_size < 1 << 16
    monkeypatch.setattr(backup_restore, "_room_in", lambda _state: 1 << 23)
    with pytest.raises(BackupError, match="more than the 8 MiB of free space"):
        restore(file, tmp_path / "state")
    assert not (tmp_path / "state").exists()


def test_a_target_that_is_a_file_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for state in (tmp_path / "file", tmp_path / "file" / "state"):
        with pytest.raises(BackupError, match=r"file.*: Not a directory"):
            restore(archive(tmp_path / "backup"), state)


def test_an_interrupted_restore_does_not_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, state = archive(tmp_path / "backup", header("api/x")), tmp_path / "state"
    seen: list[str] = []

    def torn(*_: object) -> None:
        seen.extend(one.name for one in state.iterdir())
        with pytest.raises(StartError, match="a restore did not finish: remove this folder"):
            refuse_half_restored(state)
        raise KeyboardInterrupt

    monkeypatch.setattr(backup_restore, "_extract", torn)
    with pytest.raises(KeyboardInterrupt):
        restore(file, state)
    assert sorted(seen) == ["lock", "restoring"]
    assert not state.exists()
    state.mkdir()
    (state / "restoring").touch()
    with pytest.raises(BackupError, match="is not empty"):
        restore(file, state)
    monkeypatch.undo()
    (state / "restoring").unlink()
    assert restore(file, state) == [LOG, "api/x"]
    refuse_half_restored(state)
    assert sorted(one.name for one in state.iterdir()) == ["api", "control", "lock"]


def test_a_restored_state_starts(tmp_path: Path) -> None:
    state = tmp_path / "state"
    restore(archive(tmp_path / "backup"), state)
    assert stat.S_IMODE((state / "lock").stat().st_mode) == 0o600
    (state / "control").rename(tmp_path / "out of sight")
    (state / "control").mkdir()
    assert foreign(state) is None


def test_an_existing_folder_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A failed restore removes only its own files from an empty folder such as a volume."""
    file, state = archive(tmp_path / "backup"), tmp_path / "state"
    (state / "lost+found").mkdir(parents=True)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(backup_restore, "_extract", full)
    with pytest.raises(BackupError, match="No space left"):
        restore(file, state)
    assert [one.name for one in state.iterdir()] == ["lost+found"]


def test_a_folder_changes_owner_after_its_contents(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise the new owner could replace a remaining file with a link while `restore` changes owners."""
    need_root()
    given: list[str] = []
    monkeypatch.setattr(os, "chown", lambda path, *_ids, **_more: given.append(str(path)))
    restore(archive(tmp_path / "backup", header("api/inner/file")), tmp_path / "other")
    order = [given.index(str(tmp_path / "other" / name)) for name in ("api/inner/file", "api/inner", "api")]
    assert order == sorted(order)
