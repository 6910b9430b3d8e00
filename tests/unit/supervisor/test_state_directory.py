import os
import socket
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from appliance.base.atomic_files import name_to_make
from appliance.store.state_file import RevisionRow, StateStore
from appliance.supervisor.errors import StartError
from appliance.supervisor.role import Role
from appliance.supervisor.state_directory import StateDirectory, made_before_0_4
from appliance.supervisor.users import account_of
from tests.support.engines import InlineDatabase

ROLES = (
    Role(name="control", user="rosrv", part="control"),
    Role(name="rosmaster", user="rosmaster", part="rosmaster"),
)


def test_parts_are_made_and_closed_to_others(tmp_path: Path) -> None:
    state = StateDirectory(tmp_path / "deep" / "state")
    state.prepare(ROLES)
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in state.path.iterdir()}
    assert modes == {"lock": 0o600, "run": 0o755, "control": 0o700, "rosmaster": 0o700}
    assert stat.S_IMODE(state.path.stat().st_mode) == 0o711
    state.close()


def test_leftovers_of_a_killed_process_are_removed_at_the_next_start(tmp_path: Path) -> None:
    killed = StateDirectory(tmp_path)
    killed.prepare(ROLES)
    own = name_to_make(tmp_path / "kit.tgz")
    left = [tmp_path / "control" / "audit.pub", tmp_path / "rosmaster" / "x", killed.config]
    for file in (own, *map(name_to_make, left)):
        file.touch()
    killed.close()
    state = StateDirectory(tmp_path)
    state.prepare(ROLES)
    assert [path for path in tmp_path.rglob("*.new") if path.is_file()] == [own]
    state.close()


def test_a_second_user_of_the_directory_is_refused_by_name(tmp_path: Path) -> None:
    first = StateDirectory(tmp_path)
    with pytest.raises(StartError, match=f"process {os.getpid()}"):
        StateDirectory(tmp_path)
    first.close()
    StateDirectory(tmp_path).close()


@pytest.mark.nightly
def test_a_stale_admin_socket_is_replaced(tmp_path: Path) -> None:
    state = StateDirectory(tmp_path)
    state.open_admin_socket().close()  # as after a crash: a file without a listener
    with state.open_admin_socket(), socket.socket(socket.AF_UNIX) as client:
        client.connect(str(tmp_path / "admin.sock"))
    state.close()
    assert not (tmp_path / "admin.sock").exists()


@pytest.mark.nightly
def test_a_path_too_long_for_a_socket_is_a_clear_error(tmp_path: Path) -> None:
    state = StateDirectory(tmp_path / ("x" * 120))
    with pytest.raises(StartError, match="shorter path"):
        state.open_admin_socket()
    state.close()


@pytest.mark.parametrize("kind", ["file", "link"])
def test_a_part_that_is_not_a_folder_is_refused(tmp_path: Path, kind: str) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir(mode=0o755)
    elsewhere.chmod(0o755)
    part = tmp_path / "state" / "control"
    part.parent.mkdir()
    (part.parent / "lock").write_text("")
    part.write_text("") if kind == "file" else part.symlink_to(elsewhere)
    state = StateDirectory(tmp_path / "state")
    with pytest.raises(StartError, match="control is not a folder of user id"):
        state.prepare(ROLES)
    assert stat.S_IMODE(elsewhere.stat().st_mode) == 0o755
    state.close()


def test_a_directory_that_cannot_be_made_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StartError, match=r"file/state cannot be used: .*--state DIR"):
        StateDirectory(tmp_path / "file" / "state")


def test_a_part_that_a_group_may_traverse(tmp_path: Path) -> None:
    """As root, the folder has the reader's group, which new files inherit. Without root, a single user owns it."""
    shared = (Role(name="control", user="rosrv", part="control", readable_by="rosrv-api"),)
    for roles in (ROLES[:1], shared, shared):
        state = StateDirectory(tmp_path)
        state.prepare(roles)
        state.close()
    found = (tmp_path / "control").stat()
    if os.geteuid() == 0:
        assert stat.S_IMODE(found.st_mode) == 0o2710
        assert (found.st_uid, found.st_gid) == (account_of("rosrv").uid, account_of("rosrv-api").gid)
    else:
        assert stat.S_IMODE(found.st_mode) == 0o700


def folder(path: Path, *files: str) -> Path:
    path.mkdir()
    path.chmod(0o755)
    for name in files:
        (path / name).parent.mkdir(exist_ok=True)
        (path / name).write_text("")
    return path


def test_a_directory_of_others_is_refused_and_unchanged(tmp_path: Path) -> None:
    theirs = folder(tmp_path / "theirs", "notes.txt", "a", "b", "c", "d")
    with pytest.raises(
        StartError, match=r"theirs is not the state directory.* contains a, b, c ….* name another"
    ) as said:
        StateDirectory(theirs)
    assert "--state DIR" in str(said.value)
    assert stat.S_IMODE(theirs.stat().st_mode) == 0o755
    assert not (theirs / "lock").exists()


@pytest.mark.parametrize("files", [(), ("lost+found/x",), ("lock",), ("control/state.db",)])
def test_a_directory_of_the_appliance_is_accepted(tmp_path: Path, files: tuple[str, ...]) -> None:
    state = StateDirectory(folder(tmp_path / "state", *files))
    assert stat.S_IMODE(state.path.stat().st_mode) == 0o711
    state.close()


def test_a_lock_that_is_a_link_is_not_followed(tmp_path: Path) -> None:
    """Otherwise a user with write access could have root truncate any file."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.write_text("kept")
    state = folder(tmp_path / "state")
    (state / "lock").symlink_to(elsewhere)
    with pytest.raises(StartError, match="is not the state directory"):
        StateDirectory(state)
    assert elsewhere.read_text() == "kept"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can make files of others")
def test_a_foreign_lock_makes_no_state_directory(tmp_path: Path) -> None:
    theirs = folder(tmp_path / "theirs", "lock")
    os.chown(theirs / "lock", 61099, 61099)
    with pytest.raises(StartError, match="is not the state directory"):
        StateDirectory(theirs)
    assert stat.S_IMODE(theirs.stat().st_mode) == 0o755


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives folders to other users")
def test_a_start_that_was_killed_is_completed(tmp_path: Path) -> None:
    (tmp_path / "lock").touch()
    (tmp_path / "control").mkdir()
    state = StateDirectory(tmp_path)
    state.prepare(ROLES)
    assert (tmp_path / "control").stat().st_uid == account_of("rosrv").uid
    state.close()


def test_a_state_has_the_mark_of_0_4_once_it_has_a_policy(tmp_path: Path) -> None:
    """A start that was killed at once leaves no policy. The mark may be only in the log of SQLite."""
    assert made_before_0_4(tmp_path) is None
    (tmp_path / "control").mkdir()
    store = StateStore(tmp_path / "control", failed=pytest.fail, kind=InlineDatabase)
    assert made_before_0_4(tmp_path) is None
    store.save_revision(RevisionRow(1, "", "", 0.0, "disk", ""))
    assert str(made_before_0_4(tmp_path)).startswith(
        f"{tmp_path}: the state was made by a version before 0.4"
    )
    store.save_setting("ends", "1")
    assert made_before_0_4(tmp_path) is None
    store.close()
    (tmp_path / "control" / "state.db").write_bytes(b"no database" * 100)
    with pytest.raises(OSError, match="not a database"):
        made_before_0_4(tmp_path)


@pytest.mark.real
@pytest.mark.skipif(os.geteuid() != 0, reason="a folder of another user than root")
def test_root_of_a_container_reads_the_folders_of_processes() -> None:
    for verb, before, shown in (
        ("selftest", False, "ok state {state}, mode 711"),
        ("selftest", True, "fail state {state}: the state was made by a version before 0.4"),
        ("config check", True, "state: {state}: the state was made by a version before 0.4"),
        ("standby repair", False, "Epoch 7 is forgotten"),
    ):
        with tempfile.TemporaryDirectory() as folder:  # whose parents other users may pass
            said = said_in_a_container(Path(folder), verb, before=before)
            assert shown.format(state=folder) in " ".join(said.split()), verb


def said_in_a_container(tmp_path: Path, verb: str, *, before: bool) -> str:
    tmp_path.chmod(0o711)
    for name in ("control", "lease"):
        (tmp_path / name).mkdir(0o700)
    store = StateStore(tmp_path / "control", failed=pytest.fail, kind=InlineDatabase)
    store.save_revision(RevisionRow(1, "", "", 0.0, "disk", ""))
    if not before:
        store.save_setting("ends", "1")
    store.close()
    (tmp_path / "lease" / "epoch").write_text("7")
    (tmp_path / "lock").touch()
    (tmp_path / "standby").mkdir()
    (tmp_path / "standby" / "membership.json").touch()
    for name in ("control", "lease"):
        for path in (tmp_path / name, *(tmp_path / name).iterdir()):
            os.chown(path, 61_999, 61_999)
    rights = ("setpriv", "--bounding-set=-dac_override,-dac_read_search")
    command = (*rights, sys.executable, "-c", "from appliance.cli.main import main; main()", *verb.split())
    environment = {**os.environ, "ROSRV_STATE": str(tmp_path)}
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    return run.stdout + run.stderr
