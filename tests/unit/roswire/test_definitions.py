from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from roswire.definitions import Definitions
from roswire.errors import DefinitionError

RULE = "=" * 80
Types = dict[str, dict[str, Any]]


@pytest.mark.nightly
def test_md5sums_of_full_texts_are_those_of_genpy(genpy_types: Types) -> None:
    for name, entry in genpy_types.items():
        if entry["kind"] == "msg":
            assert Definitions.from_full_text(name, entry["text"]).md5sum(name) == entry["md5sum"], name


@pytest.mark.nightly
def test_full_texts_come_back_as_they_were(genpy_types: Types) -> None:
    for name, entry in genpy_types.items():
        if entry["kind"] == "msg":
            assert Definitions.from_full_text(name, entry["text"]).full_text(name) == entry["text"], name


def test_files_are_found_by_both_forms_of_their_names() -> None:
    files = {"a/B.msg": "C c\n", "a/msg/C.msg": "int32 x\n", "a/D.srv": "B b\n---\n", "a/srv/E.srv": "---\n"}
    definitions = Definitions.from_files(files)
    assert definitions.message_types == [
        "a/B",
        "a/C",
        "a/DRequest",
        "a/DResponse",
        "a/ERequest",
        "a/EResponse",
    ]
    assert definitions.service_types == ["a/D", "a/E"]
    assert definitions.full_text("a/B") == f"C c\n\n{RULE}\nMSG: a/C\nint32 x\n"
    assert definitions.service("a/D").request is definitions.message("a/DRequest")
    assert definitions.service_md5sum("a/E") == "d41d8cd98f00b204e9800998ecf8427e"


@pytest.mark.parametrize(
    "file", ["B.msg", "a/srv/B.msg", "a/b/B.msg", "a/B.txt", "../a/B.msg", "a/B.msg\n", "/a/B.msg", ""]
)
def test_other_file_names_are_refused(file: str) -> None:
    with pytest.raises(DefinitionError, match=r"write pkg/T\.msg"):
        Definitions.from_files({file: ""})


def test_a_type_has_one_definition() -> None:
    with pytest.raises(DefinitionError, match="a/B is defined in two files"):
        Definitions.from_files({"a/B.msg": "", "a/msg/B.msg": ""})
    with pytest.raises(DefinitionError, match="a/C is defined twice"):
        Definitions.from_full_text("a/B", f"C c\n{RULE}\nMSG: a/C\n{RULE}\nMSG: a/C\n")
    with pytest.raises(DefinitionError, match="'C' is not a message type"):
        Definitions.from_full_text("a/B", f"C c\n{RULE}\nMSG: C\n")


def test_extending_lets_the_new_types_win(standard: Definitions) -> None:
    own = Definitions.from_files({"geometry_msgs/Point.msg": "float32 x\n"})
    both = standard.merge(own)
    assert both.md5sum("geometry_msgs/Point") == own.md5sum("geometry_msgs/Point")
    assert both.md5sum("geometry_msgs/Pose") != standard.md5sum("geometry_msgs/Pose")
    assert standard.md5sum("geometry_msgs/Pose") == "e45d45a5a1ce597b249e23fb30fc871f"
    assert both.service_md5sum("std_srvs/SetBool") == standard.service_md5sum("std_srvs/SetBool")


def test_unknown_types_are_named_with_similar_ones(standard: Definitions) -> None:
    with pytest.raises(
        DefinitionError, match=r"std_msgs/Strin: no such message type; did you mean .*std_msgs/String"
    ):
        standard.md5sum("std_msgs/Strin")
    with pytest.raises(DefinitionError, match="no such service type; did you mean std_srvs/SetBool"):
        standard.service_md5sum("std_srvs/SetBol")
    with pytest.raises(DefinitionError, match="a/B: field c has the type a/C, which is not defined"):
        Definitions.from_files({"a/B.msg": "C c"}).md5sum("a/B")


def test_types_that_contain_themselves_are_refused() -> None:
    definitions = Definitions.from_files({"a/B.msg": "C[] c", "a/C.msg": "B[] b", "a/D.msg": "int8 x"})
    for ask in (definitions.md5sum, definitions.layout, definitions.full_text):
        with pytest.raises(DefinitionError, match="a/B contains a/C contains a/B"):
            ask("a/B")
    assert definitions.layout("a/D").size == 1


def test_nesting_is_bounded() -> None:
    files = {f"a/T{level}.msg": f"T{level + 1} x" for level in range(64)} | {"a/T64.msg": "int8 x"}
    definitions = Definitions.from_files(files)
    with pytest.raises(DefinitionError, match="deeper than 64"):
        definitions.md5sum("a/T0")
    assert definitions.md5sum("a/T1")
    assert definitions.layout("a/T1").size == 1


def test_nesting_is_bounded_across_types_that_are_known_already() -> None:
    """The root names its deepest parts first, so each part is short when it is read."""
    levels = 300
    parts = {f"a/T{level}.msg": f"T{level + 1} x" for level in range(levels)} | {
        f"a/T{levels}.msg": "string x"
    }
    root = "".join(f"T{level} f{level}\n" for level in [*range(levels - 40, 0, -40), 0])
    definitions = Definitions.from_files(parts | {"a/Root.msg": root, "a/S.srv": f"{root}---\n{root}"})
    for ask in (definitions.md5sum, definitions.layout, definitions.full_text):
        with pytest.raises(DefinitionError, match="a/Root: messages nested deeper than 64"):
            ask("a/Root")
    with pytest.raises(DefinitionError, match="a/SRequest: messages nested deeper than 64"):
        definitions.service_md5sum("a/S")
    assert definitions.md5sum(f"a/T{levels - 63}")
    for ask in (definitions.md5sum, definitions.layout, definitions.full_text):
        with pytest.raises(DefinitionError, match=f"a/T{levels - 64}: messages nested deeper than 64"):
            ask(f"a/T{levels - 64}")


def test_layouts_do_not_explode() -> None:
    files = {f"a/T{level}.msg": f"T{level + 1} x\nT{level + 1} y" for level in range(40)} | {
        "a/T40.msg": "int8 x"
    }
    definitions = Definitions.from_files(files)
    with pytest.raises(DefinitionError, match="more than 1048576 characters"):
        definitions.layout("a/T0")
    assert len(definitions.md5sum("a/T0")) == 32
    part = "".join(f"int8 f{number}\n" for number in range(6_000))
    wide = Definitions.from_files({"a/B.msg": "C a\nC b\nC c\nC d", "a/C.msg": part})
    with pytest.raises(DefinitionError, match="more than 20000 fields"):
        wide.layout("a/B")
    huge = Definitions.from_files(
        {"a/B.msg": "C[9999999999] c", "a/C.msg": "int64[999] x", "a/D.msg": "string[9999999999] s"}
    )
    for name in ("a/B", "a/D"):
        with pytest.raises(DefinitionError, match="more than 4294967296 bytes"):
            huge.layout(name)


@pytest.mark.parametrize("brackets", ["", "[]", "[1]"])
def test_layouts_do_not_copy_the_same_fields_at_each_level(brackets: str) -> None:
    """A definition of 10 KB would make layouts of 600,000 fields, each with a path of a kilobyte."""
    levels = 50
    files = {f"a/T{level}.msg": f"T{level + 1} {'x' * 20}" for level in range(levels)} | {
        f"a/T{levels}.msg": "".join(f"int8 f{number}\n" for number in range(2_000))
    }
    files |= {f"a/A{number}.msg": f"T{levels - 4} x" for number in range(100)}
    files["a/Arrays.msg"] = "".join(f"A{number}{brackets} x{number}\n" for number in range(100))
    definitions = Definitions.from_files(files)
    for name in ("a/T0", "a/Arrays"):
        with pytest.raises(DefinitionError, match="more than 1048576 characters"):
            definitions.layout(name)
    assert definitions.layout(f"a/T{levels - 4}").size == 2_000


@given(
    text=st.lists(
        st.sampled_from(
            ["int32 ", "a", "b", "\n", "C c\n", "string[] s\n", f"{RULE}\nMSG: a/C\n", "X=1\n", "é"]
        ),
        max_size=12,
    ).map("".join)
)
def test_any_full_text_is_used_or_refused(text: str) -> None:
    try:
        definitions = Definitions.from_full_text("a/B", text)
        assert len(definitions.md5sum("a/B")) == 32
        assert definitions.layout("a/B").minimum >= 0
        again = Definitions.from_full_text("a/B", definitions.full_text("a/B"))
        assert again.md5sum("a/B") == definitions.md5sum("a/B")
    except DefinitionError as error:
        assert str(error).isprintable()
