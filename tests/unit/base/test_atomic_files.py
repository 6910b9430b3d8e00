import errno
import os
import re
import stat
import subprocess
import sys
from pathlib import Path

import pytest

import appliance
from appliance.base.atomic_files import (
    NotLastingError,
    name_to_make,
    remove_unfinished,
    write_where_told,
    write_whole,
)
from appliance.cli.output import write_told
from tests.support.requirements import need_root
from tests.support.small_disk import small_disk


def test_a_file_is_replaced_with_the_given_mode(tmp_path: Path) -> None:
    path = tmp_path / "key.pem"
    path.write_text("before")
    mask = os.umask(0o077)
    try:
        write_whole(path, b"after", 0o644)
    finally:
        os.umask(mask)
    assert (path.read_bytes(), stat.S_IMODE(path.stat().st_mode)) == (b"after", 0o644)
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "position"
    path.mkdir()
    with pytest.raises(IsADirectoryError, match=r"/position'$"):
        write_whole(path, b"after", 0o600)
    assert [*tmp_path.rglob("*")] == [path]


def test_concurrent_writers_do_not_mix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "policy.ini"
    rename = Path.rename

    def meanwhile(making: Path, name: Path) -> Path:
        monkeypatch.setattr(Path, "rename", rename)
        write_whole(path, b"of another", 0o600)
        assert making.read_bytes() == b"one's own"
        return rename(making, name)

    monkeypatch.setattr(Path, "rename", meanwhile)
    write_whole(path, b"one's own", 0o600)
    assert path.read_bytes() == b"one's own"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_sync_of_the_folder_is_reported_as_such(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "policy.ini"
    fsync = os.fsync

    def refused(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", refused)
    with pytest.raises(NotLastingError, match=r"it is replaced, .*: Input/output error.*policy\.ini"):
        write_whole(path, b"first", 0o600)
    write_told(path, b"after")
    assert path.read_bytes() == b"after"
    said = f"rosrv: {path}: it is replaced, but a power cut may restore the old content: Input/output error\n"
    assert capsys.readouterr() == ("", said)


def test_a_written_file_survives_a_power_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[tuple[str, list[str]]] = []
    fsync = os.fsync

    def noted(descriptor: int) -> None:
        fsync(descriptor)
        there = sorted(path.name for path in tmp_path.iterdir())
        synced.append((Path(f"/proc/self/fd/{descriptor}").readlink().name, there))

    monkeypatch.setattr(os, "fsync", noted)
    write_whole(tmp_path / "key.pem", b"key", 0o600)
    (making, there), folder = synced
    assert re.fullmatch(r"key\.pem\.[0-9a-f]{8}\.new", making)
    assert (there, folder) == ([making], (tmp_path.name, ["key.pem"]))


def test_leftovers_of_other_writers_do_not_block() -> None:
    sources = {path: path.read_text() for path in Path(appliance.__file__).parent.rglob("*.py")}
    fixed = re.compile(r'with_name\(f"\{\w+\.name\}\.(new|part|tmp)"')
    assert [path.name for path, text in sources.items() if fixed.search(text)] == []


def test_only_leftovers_of_killed_writers_are_removed(tmp_path: Path) -> None:
    there, elsewhere = tmp_path / "state" / "control", tmp_path / "elsewhere"
    for folder in (there, elsewhere):
        folder.mkdir(parents=True)
    left = name_to_make(there / "audit.db")
    for file in (left, there / f"{left.name}-journal", name_to_make(there.parent / "key.pem")):
        file.touch()
    kept = [
        there / name for name in ("audit.db", "x.new", "x.0123456g.new", ".01234567.new", "x.01234567.newer")
    ]
    kept += [name_to_make(elsewhere / "policy.ini"), name_to_make(there / "folder") / "file"]
    kept[-1].parent.mkdir()
    for file in kept:
        file.touch()
    (there / "link").symlink_to(elsewhere)
    name_to_make(there / "link").symlink_to(kept[0])
    links = 2
    place = os.open(tmp_path, os.O_RDONLY)
    remove_unfinished("state", place)
    remove_unfinished("nothing", place)
    os.close(place)
    found = [path for path in tmp_path.rglob("*") if not path.is_dir() and not path.is_symlink()]
    assert sorted(found) == sorted(kept)
    assert sum(path.is_symlink() for path in there.iterdir()) == links


@pytest.mark.nightly
def test_a_full_disk_error_names_the_file(tmp_path: Path) -> None:
    with small_disk(tmp_path, "4k"):
        with pytest.raises(OSError, match=r"No space left.*audit\.pub"):
            write_whole(tmp_path / "audit.pub", bytes(8192), 0o644)
        assert not list(tmp_path.iterdir())  # the unfinished file uses no space


def test_links_and_pipes_are_written_through(tmp_path: Path) -> None:
    file, link, pipe = tmp_path / "file", tmp_path / "link", tmp_path / "pipe"
    file.write_text("before")
    file.chmod(0o640)
    link.symlink_to(file)
    write_where_told(link, b"after")
    assert link.is_symlink()
    assert (file.read_bytes(), stat.S_IMODE(file.stat().st_mode)) == (b"after", 0o640)
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_where_told(pipe, b"through")
        assert os.read(reader, 100) == b"through"
    finally:
        os.close(reader)
    assert pipe.is_fifo()
    write_where_told(tmp_path / "new", b"one")
    assert (tmp_path / "new").read_bytes() == b"one"


@pytest.mark.nightly
def test_writing_to_standard_output_keeps_the_order(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("before\n")
    program = (
        "from pathlib import Path; from appliance.base.atomic_files import write_where_told as write\n"
        "print('said'); write(Path('/dev/stdout'), b'written\\n'); print('done')"
    )
    with file.open("a") as output:
        subprocess.run([sys.executable, "-c", program], stdout=output, check=True)
    assert file.read_text() == "before\nsaid\nwritten\ndone\n"


def test_a_file_gets_its_owner_before_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A killed writer leaves no file that the owner cannot read."""
    need_root()
    file = tmp_path / "policy.ini"
    file.write_text("before")
    file.chmod(0o640)
    os.chown(file, 12345, 12346)
    renamed: list[tuple[int, int, int]] = []
    rename = Path.rename

    def noted(making: Path, name: Path) -> Path:
        there = making.stat()
        renamed.append((there.st_uid, there.st_gid, stat.S_IMODE(there.st_mode)))
        return rename(making, name)

    monkeypatch.setattr(Path, "rename", noted)
    write_where_told(file, b"after")
    assert renamed == [(12345, 12346, 0o640)]
    assert (file.read_bytes(), file.stat().st_uid) == (b"after", 12345)
