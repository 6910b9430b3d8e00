"""The folder of specifications is read when it has changed, and not otherwise."""

import os
from pathlib import Path

import pytest

from appliance.specifications.folder import SpecificationFolder
from appliance.specifications.specification_files import Sources, read_folder


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The folders that were read, in order."""
    done: list[Path] = []

    def noted(folder: Path) -> Sources:
        done.append(folder)
        return read_folder(folder)

    monkeypatch.setattr("appliance.specifications.folder.read_folder", noted)
    return done


def test_it_is_read_once_as_long_as_nothing_changes(tmp_path: Path, reads: list[Path]) -> None:
    """A new file, another text with the date of the one before, a definition and a removal are changes."""
    folder = SpecificationFolder(tmp_path)
    assert folder.looked_at() == folder.looked_at() == Sources()
    assert len(reads) == 1
    (tmp_path / "a.rv").write_text("a")
    assert folder.looked_at() == folder.looked_at() == Sources({"a.rv": "a"})
    before = (tmp_path / "a.rv").stat()
    (tmp_path / "a.rv").write_text("bb")
    os.utime(tmp_path / "a.rv", ns=(before.st_atime_ns, before.st_mtime_ns))
    assert folder.looked_at() == Sources({"a.rv": "bb"})
    (tmp_path / "msg" / "own").mkdir(parents=True)
    (tmp_path / "msg" / "own" / "T.msg").write_text("int32 x")
    assert folder.looked_at() == Sources({"a.rv": "bb"}, {"own/T.msg": "int32 x"})
    (tmp_path / "a.rv").unlink()
    assert folder.looked_at() == folder.looked_at() == Sources({}, {"own/T.msg": "int32 x"})
    assert len(reads) == 5


def test_one_that_cannot_be_used_is_nothing(tmp_path: Path) -> None:
    """Whether it is gone or has a file that is no text; without a folder there are no files."""
    (tmp_path / "a.rv").write_bytes(b"\xff")
    assert SpecificationFolder(tmp_path).looked_at() is None
    assert SpecificationFolder(tmp_path / "gone").looked_at() is None
    assert SpecificationFolder(None).looked_at() == Sources()
