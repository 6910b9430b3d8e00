"""Tests of what is believed of an archive: all of it is checked before anything is written."""

import gzip
import io
import os
import tarfile
from pathlib import Path

import pytest

from appliance.backup.contents import BackupError
from appliance.backup.restore import restore
from tests.support.backups import LOG, archive, header

NOTHING = "nothing is put back"


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


def test_what_cannot_be_read(tmp_path: Path) -> None:
    """No archive, none there, one without an audit log: an error that names it."""
    (tmp_path / "rubbish").write_bytes(b"\x1f\x8b rubbish")
    refused(tmp_path / "rubbish", tmp_path / "state", "rubbish cannot be put back")
    refused(tmp_path / "nowhere", tmp_path / "state", "nowhere cannot be put back")
    (tmp_path / "other").write_bytes(gzip.compress(header("api/x") + bytes(1024)))
    refused(tmp_path / "other", tmp_path / "state", "no backup of an appliance")
