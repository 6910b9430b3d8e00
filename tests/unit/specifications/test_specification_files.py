"""Files of specifications: reading the folder, and what checking says."""

from pathlib import Path

import pytest

from appliance.specifications.checking import check
from appliance.specifications.specification_files import (
    Sources,
    SpecificationsRefusedError,
    read_folder,
)

SPEC = "a() { event said() /chatter std_msgs/String '{}' { } }"
OWN = "b() { event trigger() /trigger own_msgs/Trigger '{}' { } }"


def test_a_folder_is_read_with_its_definitions(tmp_path: Path) -> None:
    """`.rv` files by name, and `.msg` files under `msg/`, with or without a folder `msg` in the package."""
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
def test_what_is_wrong_is_said_with_its_place(sources: Sources, said: str) -> None:
    """Nothing is taken in part."""
    with pytest.raises(SpecificationsRefusedError) as error:
        check(sources, ())
    assert said in str(error.value)


def test_a_folder_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    """One that is not there, a definition that is in no package, a file that is no text."""
    with pytest.raises(SpecificationsRefusedError, match="no such folder"):
        read_folder(tmp_path / "nowhere")
    (tmp_path / "a.rv").write_bytes(b"\xff\xfe")
    with pytest.raises(SpecificationsRefusedError, match="UTF-8"):
        read_folder(tmp_path)
    (tmp_path / "a.rv").unlink()
    (tmp_path / "msg").mkdir()
    (tmp_path / "msg" / "Trigger.msg").write_text("int32 data\n")
    with pytest.raises(SpecificationsRefusedError, match="folder of its package"):
        read_folder(tmp_path)
