import asyncio
import os
import shutil
import signal
import sqlite3
import stat
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.log.log import AuditLog
from appliance.audit.proof.verification import verify
from appliance.backup import create as backup
from appliance.backup.contents import BackupError, is_passing
from appliance.backup.create import back_up, copy_database
from appliance.base.clock import wall_ns
from appliance.features.backup.restore import restore
from appliance.ipsec.signed_checkpoints import CheckpointMemory
from tests.support.audit import decision, settle
from tests.support.engines import open_log
from tests.support.requirements import need_root
from tests.support.small_disk import small_disk


@pytest.fixture
def state(tmp_path: Path) -> Path:
    state = tmp_path / "state"
    for part in ("control", "signer", "api", "ipsec", "run", "rosmaster/log"):
        (state / part).mkdir(parents=True)
    key = Ed25519PrivateKey.generate()
    memory = CheckpointMemory(state / "signer", wall_ns)

    def sign(number: int, text: bytes, *, oldest: bool = True) -> None:
        memory.accept(text)
        logs[0].store_signature(number, key.sign(text), key.public_key().public_bytes_raw())

    logs: list[AuditLog] = []
    logs.append(open_log(state / "control" / "audit.db", checkpoint_every=5, signer=sign))
    for number in range(30):
        logs[0].record(decision(logs[0], number))
        assert settle(logs[0]) is None
    logs[0].close()
    (signed,) = (state / "signer").glob("*.signed")
    with signed.open("ab") as file:
        file.write(b"\x01" * 32)  # signed after the log was copied
    with closing(sqlite3.connect(state / "control" / "state.db")) as connection:
        connection.execute("CREATE TABLE thing (value TEXT)")
        connection.execute("INSERT INTO thing VALUES ('kept')")
        connection.commit()
    for name, text in (("signer/audit.key", "secret"), ("run/config.json", "{}"), ("rosmaster/log/x.log", "x"),
                       ("control/state.ahead", "acknowledged"), ("control/audit.db.lock", ""),
                       ("ipsec/strongswan.conf", "")):  # fmt: skip
        (state / name).write_text(text)
    (state / "signer" / "audit.key").chmod(0o600)
    return state


def require_refused(state: Path, folder: Path, why: str) -> None:
    with pytest.raises(BackupError, match=why):
        back_up(state, folder / "backup.tar.gz")
    assert not (folder / "backup.tar.gz").exists()


def test_a_backup_is_restored(state: Path, tmp_path: Path) -> None:
    file, other = tmp_path / "backup.tar.gz", tmp_path / "other"
    assert not verify(state / "control" / "audit.db", signer=state / "signer").ok
    names = back_up(state, file)
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert sorted(names) == sorted(restore(file, other))
    assert {"control/audit.db", "control/audit.pub", "control/state.db", "signer/audit.key"} <= set(names)
    assert not any(
        name.startswith(("run/", "rosmaster/")) or name.endswith((".lock", ".conf")) for name in names
    )
    assert names.index("control/state.ahead") < names.index("control/state.db")  # no change is in neither
    assert (other / "control" / "state.ahead").read_text() == "acknowledged"
    assert stat.S_IMODE((other / "signer" / "audit.key").stat().st_mode) == 0o600
    result = verify(other / "control" / "audit.db", signer=other / "signer")
    assert result.ok, result.findings
    assert result.signed_checkpoints >= 5
    with closing(sqlite3.connect(other / "control" / "state.db")) as connection:
        assert connection.execute("SELECT value FROM thing").fetchall() == [("kept",)]
    assert [one.name for one in tmp_path.iterdir() if one.name.startswith(".rosrv-backup")] == []


def test_a_key_pinned_during_the_backup_is_included(
    state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pin, file = state / "control" / "audit.pub", tmp_path / "backup.tar.gz"
    key = pin.read_bytes()
    pin.unlink()

    def copied(source: Path, given: os.stat_result, target: Path) -> None:
        pin.write_bytes(key)
        copy_database(source, given, target)

    monkeypatch.setattr(backup, "copy_database", copied)
    assert back_up(state, file)[0] == "control/audit.db"
    restore(file, tmp_path / "other")
    assert verify(tmp_path / "other" / "control" / "audit.db", signer=tmp_path / "other" / "signer").ok


@pytest.mark.parametrize("step", range(7))
@pytest.mark.parametrize("before", [0, 1])
def test_a_restored_log_is_signed_on(tmp_path: Path, before: int, step: int) -> None:
    """The appliance seals and signs a checkpoint after any copied file, perhaps its first one."""
    key, logs = Ed25519PrivateKey.generate(), list[AuditLog]()

    def opened(state: Path) -> AuditLog:
        memory = CheckpointMemory(state / "signer", wall_ns)

        def sign(number: int, text: bytes, **_: object) -> None:
            memory.accept(text)
            logs[-1].store_signature(number, key.sign(text), key.public_key().public_bytes_raw())

        logs.append(open_log(state / "control" / "audit.db", checkpoint_seconds=3600, signer=sign))
        logs[-1].request_signatures()
        return logs[-1]

    def seal(log: AuditLog) -> None:
        log.record(decision(log))
        assert asyncio.run(asyncio.wait_for(log.wait_signed(), 10)) is None

    def copied(name: str, _copy: Path) -> None:
        if len(names) == step:
            seal(log)
        names.append(name)

    state, other, names = tmp_path / "state", tmp_path / "other", list[str]()
    for part in ("control", "signer"):
        (state / part).mkdir(parents=True)
    log = opened(state)
    for _number in range(before):
        seal(log)
    assert settle(log) is None
    back_up(state, tmp_path / "backup.tar.gz", copied)
    log.close()
    restore(tmp_path / "backup.tar.gz", other)
    (other / "signer").mkdir(exist_ok=True)
    seal(log := opened(other))
    log.close()
    result = verify(other / "control" / "audit.db", signer=other / "signer")
    assert (result.findings, result.signed_checkpoints) == ([], result.checkpoints)


_COMES_AND_GOES = ("fleet/segment.gz", f"control/compiled/{'a' * 64}", f"fleet/position.json.{'b' * 8}.new")


@pytest.mark.parametrize("lost", [*_COMES_AND_GOES, "signer/audit.key", "control/state.ahead"])
def test_only_what_comes_and_goes_may_be_missing_when_its_turn_comes(
    lost: str, state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (state / lost).parent.mkdir(exist_ok=True)
    (state / lost).touch()
    names = backup._names

    def lose(root: Path, part: str) -> Iterator[str]:
        yield from list(names(root, part))
        if lost.startswith(f"{part}/"):
            (root / lost).unlink()

    monkeypatch.setattr(backup, "_names", lose)
    if lost in _COMES_AND_GOES:
        assert lost not in back_up(state, tmp_path / "backup.tar.gz")
        return
    with pytest.raises(BackupError, match=f"No such file.*{Path(lost).name}"):
        back_up(state, tmp_path / "backup.tar.gz")


def test_a_backup_of_an_earlier_version_may_contain_what_comes_and_goes(
    state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in _COMES_AND_GOES[:2]:
        (state / name).parent.mkdir()
        (state / name).write_text("x")
    monkeypatch.setattr(backup, "comes_and_goes", is_passing)
    assert set(_COMES_AND_GOES[:2]) <= set(back_up(state, tmp_path / "backup.tar.gz"))
    restore(tmp_path / "backup.tar.gz", tmp_path / "other")
    assert (tmp_path / "other" / _COMES_AND_GOES[0]).read_text() == "x"


def test_a_backup_needs_no_ros(state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _program: None)
    (state / "recordings").mkdir()
    (state / "recordings" / "recording.bag").write_text("what messages said")
    names = back_up(state, tmp_path / "backup.tar.gz")
    assert sorted(names) == sorted(restore(tmp_path / "backup.tar.gz", tmp_path / "other"))
    assert not any(name.startswith("recordings/") for name in names)


def test_nothing_is_overwritten(state: Path, tmp_path: Path) -> None:
    file = tmp_path / "backup.tar.gz"
    file.write_text("mine")
    with pytest.raises(BackupError, match="already exists"):
        back_up(state, file)
    assert file.read_text() == "mine"
    file.unlink()
    back_up(state, file)
    with pytest.raises(BackupError, match="is not empty"):
        restore(file, state)


@pytest.mark.nightly
@pytest.mark.parametrize("size", ["8k", "64k"])
def test_a_full_disk_is_reported(state: Path, tmp_path: Path, size: str) -> None:
    with small_disk(tmp_path / "disk", size) as place:
        (state / "api" / "key.pem").write_bytes(os.urandom(200_000))
        with pytest.raises(BackupError, match=f"{place}: the disk is full; free space") as caught:
            back_up(state, place / "backup.tar.gz")
        assert "as root" not in str(caught.value)
        assert list(place.iterdir()) == []


def test_a_missing_state_directory_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(BackupError, match="not the state directory of an appliance"):
        back_up(tmp_path, tmp_path / "x.tar.gz")


@pytest.mark.nightly
def test_an_unreadable_part_is_an_error(state: Path, tmp_path: Path) -> None:
    need_root()
    file = Path(tempfile.mkdtemp(prefix="rosrv-backup-test-"))
    file.chmod(0o777)
    for path in (tmp_path, *tmp_path.parents):
        if path.stat().st_uid == os.geteuid() and path != Path("/"):
            path.chmod(path.stat().st_mode | 0o011)
    for path in state.rglob("*"):
        path.chmod(0o777)
    (state / "signer").chmod(0o700)
    program = (
        "import os, sys; from pathlib import Path; from appliance.backup.create import back_up;"
        "os.setgroups([]); os.setresgid(65534, 65534, 65534); os.setresuid(65534, 65534, 65534);"
        "back_up(Path(sys.argv[1]), Path(sys.argv[2]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(state), str(file / "b.tar.gz")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert "BackupError" in done.stderr
    assert "signer" in done.stderr
    assert list(file.iterdir()) == []
    file.rmdir()


def test_planted_links_and_pipes_are_refused(state: Path, tmp_path: Path) -> None:
    secret = tmp_path / "shadow"
    secret.write_text("root's")
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "inner").write_text("root's")
    (state / "api" / "link").symlink_to(secret)
    (state / "api" / "link.db").symlink_to(state / "control" / "state.db")
    (state / "api" / "folder").symlink_to(tmp_path / "outside")
    os.mkfifo(state / "api" / "pipe")
    (state / "api" / "garbage.db").write_text("no database")
    back_up(state, tmp_path / "backup.tar.gz")
    with tarfile.open(tmp_path / "backup.tar.gz") as archive:
        assert [name for name in archive.getnames() if name.startswith("api/")] == ["api/garbage.db"]


@pytest.mark.parametrize("name", ["api/key.pem", "api/folder/shadow"])
def test_a_late_link_is_not_followed(
    state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    (tmp_path / "shadow").write_text("root's")
    (state / "api" / "key.pem").symlink_to(tmp_path / "shadow")
    (state / "api" / "folder").symlink_to(tmp_path)
    seen = {"control": ["control/audit.db"], "api": [name]}
    monkeypatch.setattr(backup, "_names", lambda _state, part: seen.get(part, []))
    file = tmp_path / "backup.tar.gz"
    if name == "api/key.pem":
        assert back_up(state, file) == ["control/audit.db"]
    else:
        with pytest.raises(BackupError, match="Not a directory"):
            back_up(state, file)
        assert not file.exists()


def test_a_file_of_another_user_is_refused(state: Path, tmp_path: Path) -> None:
    need_root()
    for path in (state / "api", *(state / "api").iterdir()):
        os.chown(path, 61014, 61014)
    (tmp_path / "shadow").write_text("root's")
    os.link(tmp_path / "shadow", state / "api" / "mine")
    require_refused(state, tmp_path, "api/mine belongs to user id 0")


def test_a_sparse_file_is_refused(state: Path, tmp_path: Path) -> None:
    with (state / "api" / "hole").open("wb") as file:
        file.truncate(1 << 40)
    require_refused(state, tmp_path, "api/hole has 1099511627776 bytes")


@pytest.mark.parametrize("name", ["\x1b[2J", "x" * 97])
def test_a_name_that_cannot_be_restored_is_refused(state: Path, tmp_path: Path, name: str) -> None:
    (state / "api" / name).touch()
    require_refused(state, tmp_path, "find out its origin")


def test_a_file_that_grows_is_refused(state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = state / "api" / "growing"
    content.write_bytes(bytes(1000))
    opened = backup.open_file

    def grown(state: Path, name: str) -> int | None:
        descriptor = opened(state, name)
        if name == "api/growing":
            monkeypatch.setattr(backup, "LARGEST", 999)
        return descriptor

    monkeypatch.setattr(backup, "open_file", grown)
    require_refused(state, tmp_path, r"api/growing has more than 999 bytes: find out its origin")


def test_too_many_files_are_refused(state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backup, "MAX_FILES", 5)
    for number in range(9):
        (state / "api" / str(number)).touch()
    require_refused(state, tmp_path, r"more than 5 files, .* in api")


def test_an_interrupted_backup_leaves_no_file(
    state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(backup, "_copy_file", interrupted)
    with pytest.raises(KeyboardInterrupt):
        back_up(state, tmp_path / "backup.tar.gz")
    assert [one.name for one in tmp_path.iterdir()] == ["state"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_no_file(
    state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    """A closed terminal sends two: the second does not interrupt the removal."""
    unlink = Path.unlink

    def send() -> None:
        assert signal.getsignal(number) != signal.SIG_DFL
        signal.raise_signal(number)

    def removed(path: Path, **options: bool) -> None:
        send()
        unlink(path, **options)

    def interrupted(*_: object) -> None:
        monkeypatch.setattr(Path, "unlink", removed)
        send()

    monkeypatch.setattr(backup, "_copy_file", interrupted)
    before = signal.signal(number, signal.SIG_DFL)
    try:
        with pytest.raises(KeyboardInterrupt):
            back_up(state, tmp_path / "backup.tar.gz")
        assert signal.getsignal(number) == signal.SIG_DFL
    finally:
        signal.signal(number, before)
    assert [one.name for one in tmp_path.iterdir()] == ["state"]


def test_nohup_protects_a_backup(state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = backup.open_file

    def hung_up(state: Path, name: str) -> int | None:
        signal.raise_signal(signal.SIGHUP)
        return opened(state, name)

    monkeypatch.setattr(backup, "open_file", hung_up)
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert back_up(state, tmp_path / "backup.tar.gz")
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_half_restored_state_is_not_backed_up(state: Path, tmp_path: Path) -> None:
    (state / "restoring").touch()
    require_refused(state, tmp_path, "a restore did not finish")


@pytest.fixture
def owned(state: Path) -> Iterator[Path]:
    need_root()
    place = Path(tempfile.mkdtemp(prefix="rosrv-backup-test-"))
    place.chmod(0o711)
    owned = Path(shutil.move(state, place / "state"))
    owned.chmod(0o711)
    for path in (*(owned / "control").iterdir(), owned / "control"):
        os.chown(path, 61011, 61014)
    yield owned
    shutil.rmtree(place)


def test_open_databases_are_copied_as_their_user(owned: Path, tmp_path: Path) -> None:
    with closing(sqlite3.connect(owned / "control" / "state.db")) as connection:
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("INSERT INTO thing VALUES ('fresh')")
        connection.commit()
        for path in (owned / "control").iterdir():
            os.chown(path, 61011, 61014)
        before = (os.geteuid(), os.getegid(), os.getgroups())
        back_up(owned, tmp_path / "backup.tar.gz")
        assert (os.geteuid(), os.getegid(), os.getgroups()) == before
        assert {path.stat().st_uid for path in (owned / "control").iterdir()} == {61011}
    with tarfile.open(tmp_path / "backup.tar.gz") as archive:
        archive.extract("control/state.db", tmp_path)
    with closing(sqlite3.connect(tmp_path / "control" / "state.db")) as connection:
        assert connection.execute("SELECT value FROM thing").fetchall() == [("kept",), ("fresh",)]


def test_a_database_replaced_by_a_link_reveals_nothing_of_root(
    owned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    secret = owned.parent / "secret.db"
    with closing(sqlite3.connect(secret)) as connection:
        connection.execute("CREATE TABLE secret (value TEXT)")
        connection.commit()
    secret.chmod(0o600)
    opened = backup.open_file

    def swapped(state: Path, name: str) -> int | None:
        descriptor = opened(state, name)
        if name == "control/state.db":
            (state / name).unlink()
            (state / name).symlink_to(secret)
        return descriptor

    monkeypatch.setattr(backup, "open_file", swapped)
    require_refused(owned, tmp_path, r"control/state\.db cannot be read by its owner, user id 61011")
    assert os.geteuid() == 0
