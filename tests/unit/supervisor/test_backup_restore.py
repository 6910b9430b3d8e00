"""Tests of putting a backup back: what is refused before anything is written, and what a torn restore leaves."""

import gzip
import io
import os
import tarfile
from pathlib import Path

import pytest

from appliance.supervisor import backup_restore
from appliance.supervisor.backup_contents import BackupError
from appliance.supervisor.backup_restore import restore
from appliance.supervisor.errors import StartError
from appliance.supervisor.restore_mark import refuse_half_restored
from tests.support.requirements import need_root

LOG = "control/audit.db"
NOTHING = "nothing is put back"


def header(name: str, size: int = 0, kind: bytes = tarfile.REGTYPE, **fields: object) -> bytes:
    """The header of one entry, as a foreign program could write it."""
    entry = tarfile.TarInfo(name)
    entry.size, entry.type = size, kind
    for key, value in fields.items():
        setattr(entry, key, value)
    return entry.tobuf(tarfile.GNU_FORMAT)


def archive(file: Path, *blocks: bytes) -> Path:
    """A file of these blocks, after the audit log that every backup has."""
    file.write_bytes(gzip.compress(header(LOG) + b"".join(blocks) + bytes(1024)))
    return file


def refused(file: Path, state: Path, words: str) -> None:
    """It is not put back, these words say why, and nothing is left."""
    with pytest.raises(BackupError, match=words):
        restore(file, state)
    assert not state.exists()


@pytest.mark.parametrize(
    "name",
    [
        "../evil", "/etc/evil", "control/../../evil", "evil", "elsewhere/evil", "run/config.json", "api//x", "api/./x",
        "control/audit.db-wal", "control/audit.db-shm", "control/audit.db.lock", "control/state.ahead",
        "ipsec/strongswan.conf", "ipsec/vici.sock", "rosmaster/.local/lib/python3.11/site-packages/x.pth",
        "api/\x1b[2J", "api/a\nb", "api/" + "x" * 97,
    ],
)  # fmt: skip
def test_a_name_that_no_backup_has(tmp_path: Path, name: str) -> None:
    """It is refused whole, before anything is written."""
    file = tmp_path / "evil.tar.gz"
    with tarfile.open(file, "w:gz", format=tarfile.GNU_FORMAT) as tar:
        for one in (LOG, name):
            tar.addfile(tarfile.TarInfo(one), io.BytesIO())
    refused(file, tmp_path / "state", NOTHING)


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.DIRTYPE])
def test_only_files(tmp_path: Path, kind: bytes) -> None:
    """Links, devices and folders are in no backup."""
    refused(
        archive(tmp_path / "evil", header("api/x", kind=kind, linkname="/etc/passwd")),
        tmp_path / "s",
        NOTHING,
    )


def test_holes_are_refused(tmp_path: Path) -> None:
    """A header of a hundred bytes cannot unpack to a file of gigabytes."""
    sparse = bytearray(header("api/hole", kind=tarfile.GNUTYPE_SPARSE))
    sparse[483:495] = b"%011o\0" % (4 << 30)
    sparse[148:156] = b" " * 8
    sparse[148:156] = b"%06o\0 " % sum(sparse)
    refused(archive(tmp_path / "evil", bytes(sparse)), tmp_path / "state", NOTHING)


@pytest.mark.parametrize(
    "kind", [tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK]
)
def test_headers_that_say_more_are_refused(tmp_path: Path, kind: bytes) -> None:
    """A backup has none; they could hold gigabytes, or name a file twice."""
    text = b"20 path=api/x\0yyyyy\n".ljust(512, b"\0")
    refused(
        archive(tmp_path / "evil", header("x", 20, kind), text, header("api/x")), tmp_path / "state", NOTHING
    )


@pytest.mark.parametrize("size", [-1, 1 << 40])
def test_sizes_that_cannot_be(tmp_path: Path, size: int) -> None:
    """Less than nothing, or more than a file that is no database ever has."""
    refused(archive(tmp_path / "evil", header("api/x", size)), tmp_path / "state", NOTHING)


def test_a_name_twice(tmp_path: Path) -> None:
    """Neither as two files, nor as a file and a folder."""
    for name in (LOG, f"{LOG}/x"):
        refused(archive(tmp_path / "evil", header(name)), tmp_path / "state", NOTHING)


def test_files_without_number(tmp_path: Path) -> None:
    """A backup has a handful of files; a million of them would fill the disk with names."""
    many = b"".join(header(f"api/{number}") for number in range(10_001))
    refused(archive(tmp_path / "evil", many), tmp_path / "state", "more than 10000 files")


def test_every_flipped_bit_is_found(tmp_path: Path) -> None:
    """The file says by a checksum over all of it whether it is what was written, and it is asked."""
    content = os.urandom(2000)
    whole = archive(
        tmp_path / "whole", header("api/x", len(content)), content.ljust(2048, b"\0")
    ).read_bytes()
    file = tmp_path / "flipped"
    for place in range(10, len(whole), len(whole) // 40):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        refused(file, tmp_path / "state", "flipped cannot be put back|flipped has")
    file.write_bytes(whole[:-5])
    refused(file, tmp_path / "state", "flipped cannot be put back")


def test_more_than_there_is_room_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What unpacks to more than the disk has room for is not begun."""
    file = archive(tmp_path / "bomb", header("api/x", 1 << 24), bytes(1 << 24))
    assert file.stat().st_size < 1 << 16
    monkeypatch.setattr(backup_restore, "_room_in", lambda _state: 1 << 23)
    refused(file, tmp_path / "state", "more than the 8 MiB that there is room for")


def test_what_cannot_be_read(tmp_path: Path) -> None:
    """No archive, none there, one without an audit log: an error that names it."""
    (tmp_path / "rubbish").write_bytes(b"\x1f\x8b rubbish")
    refused(tmp_path / "rubbish", tmp_path / "state", "rubbish cannot be put back")
    refused(tmp_path / "nowhere", tmp_path / "state", "nowhere cannot be put back")
    (tmp_path / "other").write_bytes(gzip.compress(header("api/x") + bytes(1024)))
    refused(tmp_path / "other", tmp_path / "state", "no backup of an appliance")


def test_a_place_that_is_no_folder(tmp_path: Path) -> None:
    """A file in the place of the new state directory, or on the way to it: an error that names it."""
    (tmp_path / "file").touch()
    for state in (tmp_path / "file", tmp_path / "file" / "state"):
        with pytest.raises(BackupError, match=r"file.*: Not a directory"):
            restore(archive(tmp_path / "backup"), state)


def test_a_torn_restore_is_not_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed in the middle it leaves a mark, which `rosrv up` refuses; an error or Ctrl-C leaves nothing at all."""
    file, state = archive(tmp_path / "backup", header("api/x")), tmp_path / "state"
    seen: list[str] = []

    def torn(*_: object) -> None:
        seen.extend(one.name for one in state.iterdir())
        with pytest.raises(StartError, match="was not put back to its end: remove it"):
            refuse_half_restored(state)
        raise KeyboardInterrupt

    monkeypatch.setattr(backup_restore, "_extract", torn)
    with pytest.raises(KeyboardInterrupt):
        restore(file, state)
    assert seen == ["restoring"]
    assert not state.exists()
    state.mkdir()
    (state / "restoring").touch()
    with pytest.raises(BackupError, match="is not empty"):
        restore(file, state)
    monkeypatch.undo()
    (state / "restoring").unlink()
    assert restore(file, state) == [LOG, "api/x"]
    refuse_half_restored(state)
    assert sorted(one.name for one in state.iterdir()) == ["api", "control"]


def test_a_folder_that_was_there_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an empty folder, such as a volume, a failed restore takes away only what it put there."""
    file, state = archive(tmp_path / "backup"), tmp_path / "state"
    state.mkdir()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(backup_restore, "_extract", full)
    with pytest.raises(BackupError, match="No space left"):
        restore(file, state)
    assert list(state.iterdir()) == []


def test_a_folder_is_given_away_after_what_is_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While `restore` hands a part over, its user cannot put a link in the place of what is still to be given away."""
    need_root()
    given: list[str] = []
    monkeypatch.setattr(os, "chown", lambda path, *_ids, **_more: given.append(str(path)))
    restore(archive(tmp_path / "backup", header("api/inner/file")), tmp_path / "other")
    order = [given.index(str(tmp_path / "other" / name)) for name in ("api/inner/file", "api/inner", "api")]
    assert order == sorted(order)
