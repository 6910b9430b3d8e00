import time
import xmlrpc.client

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roswire.errors import PeerError
from roswire.xmlrpc import Value, XmlRpcLimits, build_response, parse_call
from roswire.xmlrpc.common_documents import read_common_answer, read_common_call
from roswire.xmlrpc.xmlrpc_reader import XmlRpcDocument
from tests.support.examples import examples

NAMES = st.one_of(
    st.text("/abc_09 :.~;\"'", max_size=12), st.text(max_size=5), st.sampled_from(["&", "]]>", "a\rb"])
)
SCALARS: st.SearchStrategy[Value] = st.one_of(
    NAMES, st.integers(-(2**31), 2**31 - 1), st.booleans(), st.floats(allow_nan=False)
)
ROSCPP = (
    b'<?xml version="1.0"?>\r\n<methodCall><methodName>registerPublisher</methodName>\r\n<params>'
    b"<param><value>/talker</value></param><param><value><i4>-7</i4></value></param></params></methodCall>\r\n"
)


def walked(body: bytes, root: str, limits: XmlRpcLimits) -> tuple[str, list[Value]] | None:
    try:
        document = XmlRpcDocument(body, limits, root)
    except PeerError:
        return None
    return document.method, document.values


def dumped(values: list[Value], method: str | None) -> bytes:
    if method is not None:
        return xmlrpc.client.dumps(tuple(values), method).encode("utf-8", "surrogatepass")
    return xmlrpc.client.dumps((values,), methodresponse=True).encode("utf-8", "surrogatepass")


def parts(*params: list[Value]) -> list[Value]:
    return [[{"methodName": "setParam", "params": param} for param in params]]


LIST = b"<value><array><data></data></array></value>"
LISTS: st.SearchStrategy[Value] = st.lists(SCALARS, max_size=3)


@given(values=st.lists(st.one_of(SCALARS, LISTS, st.lists(LISTS, max_size=2)), max_size=4), data=st.data())
@settings(max_examples=examples(1000))
def test_the_pattern_and_the_walk_read_the_same_values(values: list[Value], data: st.DataObject) -> None:
    whole = [dumped(values, "registerService"), dumped(values, None), ROSCPP]
    whole.append(dumped(parts(values, ["/a", "/b", 1]), "system.multicall"))
    body = bytearray(data.draw(st.sampled_from(whole)))
    for _ in range(data.draw(st.integers(0, 3))):
        at = data.draw(st.integers(0, len(body) - 1))
        piece = data.draw(
            st.sampled_from([b"", b"<", b">", b"&", b"\r", b"]]>", b"/", b" ", b"<value>", b"\x00", b"9"])
        )
        body[at : at + data.draw(st.integers(0, 2))] = piece
    limits = XmlRpcLimits(
        elements=data.draw(st.sampled_from([3, 10**6])), string=data.draw(st.sampled_from([5, 10**6]))
    )
    call = read_common_call(bytes(body), limits)
    assert call is None or call == walked(bytes(body), "methodCall", limits)
    answer = read_common_answer(bytes(body), limits)
    assert answer is None or ("", [answer]) == walked(bytes(body), "methodResponse", limits)


@pytest.mark.parametrize("quote", [b"'", b'"'])
def test_calls_of_ros_clients_and_answers_of_rosmaster_are_usual(quote: bytes) -> None:
    told: list[Value] = ["/talker", "/chatter", "std_msgs/String", "http://10.0.0.5:40001/"]
    python = dumped(told, "registerPublisher").replace(b"version='1.0'", b"version=%b1.0%b" % (quote, quote))
    assert read_common_call(python, XmlRpcLimits()) == ("registerPublisher", told)
    assert read_common_call(ROSCPP, XmlRpcLimits()) == ("registerPublisher", ["/talker", -7])
    last: list[Value] = [0, "", ["http://10.0.0.5:40001/", "http://10.0.0.5:40002/"], []]
    for value in last:
        answer: list[Value] = [1, "Registered [/talker] as publisher of [/chatter]", value]
        assert read_common_answer(dumped(answer, None), XmlRpcLimits()) == answer
        assert read_common_answer(build_response(answer), XmlRpcLimits()) == answer
    several: list[Value] = [
        [[1, f"parameter /a/{place} set", value]] for place, value in enumerate(last * 16)
    ]
    assert read_common_answer(dumped(several, None), XmlRpcLimits()) == several


@pytest.mark.parametrize("value", [7, True, False, -0.5, 1e-05, "", "a b", [1.5, 2.0], []])
def test_a_multicall_of_roslaunch_is_usual_however_long(value: Value) -> None:
    params: list[Value] = ["/roslaunch", "/start/part/value", value]
    several = parts(*[params] * 2000)
    body = dumped(several, "system.multicall")
    assert read_common_call(body, XmlRpcLimits()) == ("system.multicall", several)
    for limits in (
        XmlRpcLimits(parts=1999),
        XmlRpcLimits(elements=2000),
        XmlRpcLimits(body=1000),
        XmlRpcLimits(depth=1),
    ):
        with pytest.raises(PeerError):
            parse_call(body, limits)


@pytest.mark.parametrize(
    "value", [{"a": {"b": [1, {}]}}, "x" * 40_000, [[[1]]], "<robot/>\n", "<struct>", "]]>", {}], ids=repr
)
def test_a_part_that_is_not_plain_is_left_to_the_walk_alone(value: Value) -> None:
    several = parts(["/a", "/b", 1], ["/a", "/c", value], ["/a", "/d", 2])
    body = dumped(several, "system.multicall")
    assert read_common_call(body, XmlRpcLimits()) == ("system.multicall", several)
    for depth in range(1, 8):
        read = read_common_call(body, XmlRpcLimits(depth=depth))
        assert read is None or read == walked(body, "methodCall", XmlRpcLimits(depth=depth))


def test_two_values_are_not_taken_for_one_struct() -> None:
    first, second = (b"<value><struct><!--<%bstruct>--></struct></value>" % slash for slash in (b"", b"/"))
    within = first + b"</param><param>" + second
    body = dumped(parts(["/a"]), "system.multicall")
    body = body.replace(b"<data>\n<value>", b"<data>\n" + within + b"<value>", 1)
    assert within in body
    assert read_common_call(body, XmlRpcLimits()) is None
    assert walked(body, "methodCall", XmlRpcLimits()) is None


def test_few_parts_are_walked_alone() -> None:
    params: list[Value] = ["/a", "/b", {}]
    several = parts(*[params] * 256)
    body = dumped(several, "system.multicall")
    assert read_common_call(body, XmlRpcLimits()) is None
    assert parse_call(body).params == tuple(several)


PIECES = [
    b"<struct>",
    b"</struct>",
    b"</value>",
    b"<!--",
    b"-->",
    b"<![CDATA[",
    b"]]>",
    b"</param><param>",
    b"<value>1</value>",
]


@given(data=st.data())
@settings(max_examples=examples(1000))
def test_no_struct_hides_what_is_around_it(data: st.DataObject) -> None:
    given: list[list[Value]] = [
        ["/a", "/b", 1],
        ["/a", "/c", {"d": {"e": 1}}],
        ["/a", "/f", "<&"],
        ["/a", "/g", 2],
    ]
    body = dumped(
        parts(*data.draw(st.lists(st.sampled_from(given), min_size=1, max_size=4))), "system.multicall"
    )
    places = [at for at in range(len(body)) if body[at : at + 1] in b"<>"]
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.sampled_from(places)) + data.draw(st.integers(0, 1))
        body = body[:at] + data.draw(st.sampled_from(PIECES)) + body[at:]
    call = read_common_call(body, XmlRpcLimits())
    assert call is None or call == walked(body, "methodCall", XmlRpcLimits())


@pytest.mark.parametrize("piece", [b" ", b"\n", b"<value>a</value>", b"<value>a</value> \n", b"1"])
@pytest.mark.parametrize("before", [b"", b"<value>", b"<value><int>", LIST, LIST[:20]])
def test_an_invalid_document_takes_linear_time(piece: bytes, before: bytes) -> None:
    short, long = (spoilt(before, piece, 1_000_000 // shorter) for shorter in (16, 1))
    of_short, of_long = (min(seconds_to_leave(texts) for _ in range(3)) for texts in (short, long))
    assert of_long < 64 * (of_short + 0.0005)  # 16 times as long; a quadratic pattern takes 256 times as long


def spoilt(before: bytes, piece: bytes, size: int) -> list[bytes]:
    some = piece * (size // 32 // len(piece))
    whole = dumped(["a"], None).partition(b"<value>")[0] + before + some + b"<"
    texts = [whole, whole.replace(b"<methodResponse>", b"<methodCall><methodName>m</methodName>")]
    part = b"<value><struct><member><name>methodName</name><value><string>a</string></value></member>"
    part += b"<member><name>params</name>" + LIST + b"</member></struct></value>"
    for within in (part, part[: part.index(b"<data>") + 6] + some):
        several = whole.partition(b"<value>")[0] + LIST[:20] + within * (size // len(within)) + b"<"
        head = b"<methodCall><methodName>system.multicall</methodName>"
        texts.append(several.replace(b"<methodResponse>", head)[:size])
    return texts


def seconds_to_leave(texts: list[bytes]) -> float:
    begun = time.thread_time()
    answer, *calls = texts
    assert read_common_answer(answer, XmlRpcLimits()) is None
    assert [read_common_call(call, XmlRpcLimits()) for call in calls] == [None] * len(calls)
    return time.thread_time() - begun


def test_one_value_too_many_is_refused_however_short() -> None:
    body = dumped(["a"] * 4, "m")
    with pytest.raises(PeerError, match="more than 3 values"):
        parse_call(body, XmlRpcLimits(elements=3))
