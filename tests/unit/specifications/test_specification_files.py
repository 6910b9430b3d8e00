import os
from pathlib import Path

import pytest

from appliance.specifications.checking import check
from appliance.specifications.specification_files import (
    Sources,
    SpecificationFolder,
    SpecificationsRefusedError,
    read_folder,
)
from tests.support.site_key import LINE, NAME, signed
from tests.support.unreadable_folders import make_unreadable

SPEC = "a() { event said() /chatter std_msgs/String '{}' { } }"
OWN = "b() { event trigger() /trigger own_msgs/Trigger '{}' { } }"


def test_a_folder_is_read_with_its_definitions(tmp_path: Path) -> None:
    (tmp_path / "b.rv").write_text(OWN)
    (tmp_path / "a.rv").write_text("﻿" + SPEC)
    (tmp_path / "notes.txt").write_text("not a specification")
    (tmp_path / "msg" / "own_msgs" / "msg").mkdir(parents=True)
    (tmp_path / "msg" / "own_msgs" / "msg" / "Trigger.msg").write_text("int32 data\n")
    sources = read_folder(tmp_path)
    assert list(sources.files) == ["a.rv", "b.rv"]
    assert sources.files["a.rv"] == SPEC
    assert sources.definitions == {"own_msgs/Trigger.msg": "int32 data\n"}
    checked = check(sources, ())
    assert checked.monitors == {"a": "a.rv", "b": "b.rv"}
    assert checked.of_topic("/trigger")
    assert not checked.of_topic("/other")


@pytest.mark.parametrize(
    ("sources", "said"),
    [
        (Sources({"a.rv": "a() { event }"}), "a.rv:1:13: error"),
        (Sources({"b.rv": OWN}), "own_msgs/Trigger"),
        (Sources({"a.rv": SPEC}, {"own_msgs/Trigger.msg": "no such type"}), "own_msgs/Trigger.msg"),
        (Sources({"a.rv": SPEC + " " * (1 << 20)}), "a.rv: longer than"),
        (Sources({"a.rv": SPEC}, {"own_msgs/T.msg": "#" * (4 << 20)}), "longer than 3145728"),
        (Sources({"a.rv": SPEC, "c.rv": SPEC}), "there is another specification"),
    ],
)
def test_a_mistake_in_a_file_is_reported_with_its_place(sources: Sources, said: str) -> None:
    with pytest.raises(SpecificationsRefusedError) as error:
        check(sources, ())
    assert said in str(error.value)


def test_a_folder_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SpecificationsRefusedError, match="does not exist"):
        read_folder(tmp_path / "nowhere")
    (tmp_path / "a.rv").write_bytes(b"\xff\xfe")
    with pytest.raises(SpecificationsRefusedError, match="UTF-8"):
        read_folder(tmp_path)
    (tmp_path / "a.rv").unlink()
    (tmp_path / "msg").mkdir()
    (tmp_path / "msg" / "Trigger.msg").write_text("int32 data\n")
    with pytest.raises(SpecificationsRefusedError, match="folder of its package"):
        read_folder(tmp_path)


@pytest.mark.parametrize("name", ["", "msg", "msg/own_msgs"])
def test_an_unreadable_folder_is_not_an_empty_one(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "msg" / "own_msgs").mkdir(parents=True)
    make_unreadable(tmp_path / name, monkeypatch)
    with pytest.raises(SpecificationsRefusedError, match="cannot be read: Permission denied"):
        read_folder(tmp_path)


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    done: list[Path] = []

    def noted(folder: Path) -> Sources:
        done.append(folder)
        return read_folder(folder)

    monkeypatch.setattr("appliance.specifications.specification_files.read_folder", noted)
    return done


def test_the_folder_is_read_again_only_after_a_change(tmp_path: Path, reads: list[Path]) -> None:
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


def test_an_unusable_folder_has_no_files(tmp_path: Path) -> None:
    (tmp_path / "a.rv").write_bytes(b"\xff")
    assert SpecificationFolder(tmp_path).looked_at() is None
    assert SpecificationFolder(tmp_path / "gone").looked_at() is None
    assert SpecificationFolder(None).looked_at() == Sources()


@pytest.mark.parametrize("name", ["a.rv", "own_msgs/Trigger.msg", "msg/own_msgs/Trigger.msg"])
@pytest.mark.parametrize("unsigned", ["files", "definitions"])
def test_a_text_needs_its_own_signature_although_another_of_its_name_has_one(
    name: str, unsigned: str
) -> None:
    texts = {"files": {name: SPEC}, "definitions": {name: SPEC}}
    good = Sources(texts["files"], texts["definitions"], {name: signed(SPEC)})
    assert good.signers([LINE]) == [NAME]
    texts[unsigned] = {name: OWN}
    sources = Sources(texts["files"], texts["definitions"], good.signatures)
    with pytest.raises(SpecificationsRefusedError, match="is not the text"):
        sources.signers([LINE])
    left, errors = sources.signed_only([LINE])
    assert OWN not in left.by_name().values()
    assert list(errors) == [name if unsigned == "files" else f"msg/{name}"]
