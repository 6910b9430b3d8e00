import gzip
import io
import random
import tarfile
from pathlib import Path

import pytest

from appliance.backup.contents import BackupError
from appliance.features.backup.restore import restore
from tests.support.backups import LOG, archive, header

NOTHING = "nothing is restored"


def refused(file: Path, state: Path, words: str) -> None:
    with pytest.raises(BackupError, match=words):
        restore(file, state)
    assert not state.exists()


@pytest.mark.parametrize(
    "name",
    [
        "../evil", "/etc/evil", "control/../../evil", "evil", "elsewhere/evil", "run/config.json", "api//x", "api/./x",
        "control/audit.db-wal", "control/audit.db-shm", "control/audit.db.lock",
        "ipsec/strongswan.conf", "ipsec/vici.sock", "rosmaster/.local/lib/python3.11/site-packages/x.pth",
        "api/\x1b[2J", "api/a\nb", "api/" + "x" * 97,
    ],
)  # fmt: skip
def test_an_unknown_name_is_rejected(tmp_path: Path, name: str) -> None:
    file = tmp_path / "evil.tar.gz"
    with tarfile.open(file, "w:gz", format=tarfile.GNU_FORMAT) as tar:
        for one in (LOG, name):
            tar.addfile(tarfile.TarInfo(one), io.BytesIO())
    refused(file, tmp_path / "state", NOTHING)


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.DIRTYPE])
def test_only_files_are_accepted(tmp_path: Path, kind: bytes) -> None:
    refused(
        archive(tmp_path / "evil", header("api/x", kind=kind, linkname="/etc/passwd")),
        tmp_path / "s",
        NOTHING,
    )


def test_sparse_files_are_rejected(tmp_path: Path) -> None:
    """A header of a hundred bytes would unpack to a file of gigabytes."""
    sparse = bytearray(header("api/hole", kind=tarfile.GNUTYPE_SPARSE))
    sparse[483:495] = b"%011o\0" % (4 << 30)
    sparse[148:156] = b" " * 8
    sparse[148:156] = b"%06o\0 " % sum(sparse)
    refused(archive(tmp_path / "evil", bytes(sparse)), tmp_path / "state", NOTHING)


@pytest.mark.parametrize(
    "kind", [tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK]
)
def test_extended_headers_are_rejected(tmp_path: Path, kind: bytes) -> None:
    """A header could hold gigabytes, or name a file twice."""
    text = b"20 path=api/x\0yyyyy\n".ljust(512, b"\0")
    refused(
        archive(tmp_path / "evil", header("x", 20, kind), text, header("api/x")), tmp_path / "state", NOTHING
    )


@pytest.mark.parametrize("size", [-1, 1 << 40])
def test_impossible_sizes_are_rejected(tmp_path: Path, size: int) -> None:
    refused(archive(tmp_path / "evil", header("api/x", size)), tmp_path / "state", NOTHING)


def test_a_duplicate_name_is_rejected(tmp_path: Path) -> None:
    for name in (LOG, f"{LOG}/x"):
        refused(archive(tmp_path / "evil", header(name)), tmp_path / "state", NOTHING)


def test_too_many_files_are_rejected(tmp_path: Path) -> None:
    many = b"".join(header(f"api/{number}") for number in range(10_001))
    refused(archive(tmp_path / "evil", many), tmp_path / "state", "more than 10000 files")


def test_every_flipped_bit_is_found(tmp_path: Path) -> None:
    content = random.Random(1).randbytes(2000)  # noqa: S311  some bits of a compressed file may have two values
    whole = archive(
        tmp_path / "whole", header("api/x", len(content)), content.ljust(2048, b"\0")
    ).read_bytes()
    file = tmp_path / "flipped"
    for place in range(10, len(whole), len(whole) // 40):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        refused(file, tmp_path / "state", "flipped cannot be restored|flipped has")
    file.write_bytes(whole[:-5])
    refused(file, tmp_path / "state", "flipped cannot be restored")


def test_an_unreadable_archive_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "rubbish").write_bytes(b"\x1f\x8b rubbish")
    refused(tmp_path / "rubbish", tmp_path / "state", "rubbish cannot be restored")
    refused(tmp_path / "nowhere", tmp_path / "state", "nowhere cannot be restored")
    (tmp_path / "other").write_bytes(gzip.compress(header("api/x") + bytes(1024)))
    refused(tmp_path / "other", tmp_path / "state", "not a backup of an appliance")
