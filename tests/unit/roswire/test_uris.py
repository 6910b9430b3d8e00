import pytest
from hypothesis import given
from hypothesis import strategies as st

from roswire.errors import InvalidUriError
from roswire.uris import NodeUri, node_uri, parse_node_uri, parse_service_uri, service_uri
from tests.unit.roswire.tables import rows


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("http://robot:11311/", NodeUri("http", "robot", 11311, "/")),
        ("http://robot:11311", NodeUri("http", "robot", 11311, "/")),
        ("http://127.0.0.1:1/a1b2/", NodeUri("http", "127.0.0.1", 1, "/a1b2/")),
        ("http://my_robot-1.local.:65535/", NodeUri("http", "my_robot-1.local.", 65535, "/")),
        ("http://[::1]:8080/", NodeUri("http", "::1", 8080, "/")),
        ("http://[FE80:0:0::1]:8080/", NodeUri("http", "fe80::1", 8080, "/")),
        ("http://::1:8080/", NodeUri("http", "::1", 8080, "/")),
        ("http://fe80::a:1:8080", NodeUri("http", "fe80::a:1", 8080, "/")),
        ("HTTP://robot:1/", NodeUri("http", "robot", 1, "/")),
    ],
)
def test_node_uris_as_ros_writes_them(text: str, expected: NodeUri) -> None:
    assert parse_node_uri(text) == expected


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        *rows("URIs of nodes that are refused"),
        ("", "empty"),
        ("http://robot:1/" + "a" * 2000, "2015 characters"),
    ],
)
def test_refused_node_uris_say_why(text: str, complaint: str) -> None:
    with pytest.raises(InvalidUriError, match=complaint) as refused:
        parse_node_uri(text)
    assert str(refused.value).isprintable()


def test_service_uris() -> None:
    assert parse_service_uri("rosrpc://robot:4321") == NodeUri("rosrpc", "robot", 4321, "")
    assert parse_service_uri("rosrpc://[::1]:4321/") == NodeUri("rosrpc", "::1", 4321, "")
    with pytest.raises(InvalidUriError, match="has a path"):
        parse_service_uri("rosrpc://robot:4321/a")
    with pytest.raises(InvalidUriError, match="scheme 'http'"):
        parse_service_uri("http://robot:4321")


@given(
    host=st.one_of(
        st.ip_addresses().map(str), st.from_regex(r"[a-z][a-z0-9-]{0,20}(\.[a-z]{1,5})?", fullmatch=True)
    ),
    port=st.integers(1, 65535),
)
def test_a_written_uri_is_read_back(host: str, port: int) -> None:
    assert parse_node_uri(node_uri(host, port)) == NodeUri("http", host, port, "/")
    assert parse_node_uri(node_uri(host, port, "/key/")) == NodeUri("http", host, port, "/key/")
    assert parse_service_uri(service_uri(host, port)) == NodeUri("rosrpc", host, port, "")


@given(
    text=st.text(alphabet="htp:/[]@?#1a.\\\n\u00e9 ", max_size=20),
    prefix=st.sampled_from(["", "http://", "rosrpc://"]),
)
def test_any_text_is_read_or_refused(text: str, prefix: str) -> None:
    for parse, write in ((parse_node_uri, node_uri), (parse_service_uri, service_uri)):
        try:
            uri = parse(prefix + text)
        except InvalidUriError:
            continue
        again = write(uri.host, uri.port, uri.path) if write is node_uri else service_uri(uri.host, uri.port)
        assert parse(again) == uri
