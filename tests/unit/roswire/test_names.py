from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roswire import names
from roswire.errors import InvalidNameError, PeerError
from tests.support.examples import examples
from tests.support.nodes import answering
from tests.unit.roswire.tables import rows

Oracle = Callable[[str, str], list[str | None]]

NODE_IDS = st.sampled_from(["", "/talker", "/ns/talker", "/a/b/c", "/_x/1y"])
CALLER_IDS = st.one_of(NODE_IDS, st.just("/rosparam-4711"))
NAME_LIKE = st.text(alphabet="aZ0_/~.- :\n\u00e9\u0430", max_size=12)


@pytest.fixture(scope="module")
def rosmaster() -> Iterator[Oracle]:
    with answering(str(Path(__file__).with_name("rosgraph_names.py"))) as ask:
        yield lambda name, caller_id: ask([name, caller_id])


@pytest.mark.nightly
@settings(max_examples=examples(2000))
@given(name=NAME_LIKE, caller_id=CALLER_IDS)
def test_resolve_agrees_with_rosmaster(rosmaster: Oracle, name: str, caller_id: str) -> None:
    try:
        resolved = names.resolve(name, caller_id)
    except InvalidNameError:
        return
    assert rosmaster(name, caller_id) == [resolved, resolved]
    assert names.is_global_name(resolved)
    assert names.resolve(resolved, "/other/node") == resolved


@pytest.mark.nightly
@settings(max_examples=examples(1000))
@given(name=NAME_LIKE, caller_id=CALLER_IDS)
def test_resolve_parameter_agrees_with_rosmaster(rosmaster: Oracle, name: str, caller_id: str) -> None:
    for resolve in (names.resolve_parameter, names.resolve_namespace):
        try:
            resolved = resolve(name, caller_id)
        except InvalidNameError:
            continue
        assert rosmaster(name, caller_id)[0] == resolved
        assert "//" not in resolved
        assert resolved == "/" or not resolved.endswith("/")


@pytest.mark.nightly
@settings(max_examples=examples(500))
@given(name=st.from_regex(r"[A-Za-z/~][A-Za-z0-9_/]{0,12}", fullmatch=True), caller_id=NODE_IDS)
def test_every_ros_name_resolves(rosmaster: Oracle, name: str, caller_id: str) -> None:
    resolved = rosmaster(name, caller_id)[0]
    assert names.resolve_namespace(name, caller_id) == resolved
    if resolved != "/":
        assert names.resolve(name, caller_id) == resolved


@given(text=st.text(max_size=30), caller_id=st.text(max_size=10))
def test_any_text_resolves_or_is_refused(text: str, caller_id: str) -> None:
    for function in (names.resolve, names.resolve_namespace, names.resolve_parameter):
        try:
            assert function(text, caller_id).isascii()
        except PeerError as error:
            assert str(error).isprintable()
    names.is_global_name(text)
    names.is_valid_type_name(text)


@pytest.mark.parametrize(
    ("name", "caller_id", "expected"),
    [
        *rows("names, callers and the canonical names"),
        ("chatter", "", "/chatter"),
    ],
)
def test_resolve_makes_the_canonical_name(name: str, caller_id: str, expected: str) -> None:
    assert names.resolve(name, caller_id) == expected


@pytest.mark.parametrize(
    "name",
    [
        *(row for (row,) in rows("names that are refused")),
        "",
        "/" + "a" * 2000,
        "\ud800",
    ],
)
def test_resolve_refuses_what_is_not_a_ros_name(name: str) -> None:
    with pytest.raises(InvalidNameError):
        names.resolve(name, "/talker")


def test_refusal_names_the_character_and_its_place() -> None:
    with pytest.raises(InvalidNameError, match=r"'/a b'.*character 3 is ' '"):
        names.resolve("/a b", "/talker")
    with pytest.raises(InvalidNameError, match="starts with a letter"):
        names.resolve("1a", "/talker")
    with pytest.raises(InvalidNameError, match=r"character 4 is '\?'; allowed are printable ASCII"):
        names.resolve_parameter("a-b?", "/talker")
    with pytest.raises(InvalidNameError, match="starts or ends with a space"):
        names.resolve_parameter("/a b/ c", "/talker")
    with pytest.raises(InvalidNameError, match="2001 characters; at most 1024"):
        names.resolve("/" + "a" * 2000, "/talker")


@pytest.mark.parametrize("caller_id", ["talker", "/", "~a", "/a b", "/\u0430"])
def test_relative_names_need_a_valid_caller(caller_id: str) -> None:
    for name in ("chatter", "~chatter"):
        with pytest.raises(InvalidNameError):
            names.resolve(name, caller_id)
    assert names.resolve("/chatter", caller_id) == "/chatter"


def test_tools_with_a_hyphen_resolve_what_is_a_name() -> None:
    assert names.canonical_tool_id("/rosparam-4711") == "/rosparam-4711"
    assert names.resolve("chatter", "/rosparam-4711") == "/chatter"
    assert names.resolve_parameter("~a", "/rosparam-4711") == "/rosparam-4711/a"
    for caller_id in ("/rosparam-4711", "/a-b/tool"):
        with pytest.raises(InvalidNameError, match=r"character .* is '-'"):
            names.resolve("~a" if caller_id != "/a-b/tool" else "a", caller_id)
    for caller_id in ("", "/", "tool-1", "/tool 1", "/t-\u0430", "/" + "a-" * 600):
        with pytest.raises(InvalidNameError):
            names.canonical_tool_id(caller_id)


def test_a_name_may_not_grow_too_long() -> None:
    caller_id = "/" + "a" * 600
    assert names.is_global_name(names.resolve("~" + "b" * 400, caller_id))
    with pytest.raises(InvalidNameError, match="1202 characters; at most 1024"):
        names.resolve("~" + "b" * 600, caller_id)


def test_namespace_variant_allows_the_root() -> None:
    assert names.resolve_namespace("/", "/talker") == "/"
    assert names.resolve_namespace("//", "/talker") == "/"
    assert names.resolve_parameter("/", "/talker") == "/"


@pytest.mark.parametrize(
    "name",
    [
        "/roslaunch/uris/host_abc__4321",
        "/run_id",
        "/robot_description",
        "/arm/joint-1.left/gains/p",
        "/analyzers/Base Driver/type",
        "/move_group/ompl/RRTConnectkConfigDefault",
        "/rosdistro",
        "/costmap/2d/inflation",
        "/hw:0/device",
        "/a/_b",
    ],
)
def test_parameters_of_real_robots_pass(name: str) -> None:
    assert names.resolve_parameter(name, "/talker") == name
    assert names.resolve_parameter(name + "/", "/talker") == name


@pytest.mark.parametrize(
    "name", ["", "/a\n", "/a*", "/a?", '/a"', "/a\\b", "/ a", "/a /b", "/a ", " ", "/a/~b", "/caf\u00e9"]
)
def test_parameters_that_could_mislead_are_refused(name: str) -> None:
    with pytest.raises(InvalidNameError):
        names.resolve_parameter(name, "/talker")


def test_a_member_that_no_key_names_is_had_with_its_namespace() -> None:
    assert names.is_relative_member("\u00fc")
    with pytest.raises(InvalidNameError, match="such a member is read and set with its namespace"):
        names.resolve_parameter("/ns/\u00fc", "/talker")


@pytest.mark.parametrize("caller_id", ["/a", "/a/b", "/rostopic_4_1699999999999", "/_a", "/1"])
def test_caller_id_is_returned_unchanged(caller_id: str) -> None:
    assert names.canonical_caller_id(caller_id) is caller_id


@pytest.mark.parametrize(
    "caller_id",
    ["", "/", "//", "a", "~a", "a//b", "/a\n", "/a/\n", "/a b", "//a-b", "/\u0430", "/" + "a" * 1024],
)
def test_caller_id_must_be_a_global_name(caller_id: str) -> None:
    with pytest.raises(InvalidNameError, match="caller_id"):
        names.canonical_caller_id(caller_id)
    assert not names.is_global_name(caller_id)


@pytest.mark.parametrize(
    ("caller_id", "canonical"),
    [("//a", "/a"), ("/ns//a", "/ns/a"), ("/a/", "/a"), ("///ns///a//", "/ns/a"), ("/" * 1000 + "a", "/a")],
)
def test_caller_id_is_folded_as_by_rospy_and_roscpp(caller_id: str, canonical: str) -> None:
    """rosgo sends `//name` where rospy and roscpp send `/name`. Relative names are resolved against the folded name."""
    assert names.canonical_caller_id(caller_id) == names.canonical_tool_id(caller_id) == canonical
    assert names.resolve("x", caller_id) == names.resolve("x", canonical)
    assert names.resolve("~x", caller_id) == f"{canonical}/x"
    assert names.canonical_tool_id("//rosparam-4711/") == "/rosparam-4711"


def test_namespace_and_join_are_inverse() -> None:
    assert [names.namespace(name) for name in ("/a/b/c", "/a", "/", "")] == ["/a/b/", "/", "/", "/"]
    assert names.join("/a/b/", "c") == names.join("/a/b", "c") == "/a/b/c"
    assert names.join("/a", "/c") == "/c"
    assert names.join("/a", "~c") == "~c"
    assert names.join("", "c") == "c"


@pytest.mark.parametrize(
    ("name", "valid"),
    [
        ("*", True),
        ("std_msgs/String", True),
        ("move_base_msgs/MoveBaseActionGoal", True),
        ("std_msgs", False),
        ("", False),
        ("a/b/c", False),
        ("std_msgs/msg/String", False),
        ("/String", False),
        ("std_msgs/", False),
        ("std_msgs/St ring", False),
        ("**", False),
        ("std_msgs/String\n", False),
    ],
)
def test_type_names(name: str, valid: bool) -> None:
    assert names.is_valid_type_name(name) is valid
