import datetime
import math
import time
import xmlrpc.client
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from roswire.errors import EncodingError, LimitExceededError, PeerError, ProtocolError
from roswire.xmlrpc import (
    FaultReceived,
    MethodCall,
    Value,
    XmlRpcLimits,
    build_call,
    build_fault,
    build_response,
    parse_call,
    parse_response,
)
from tests.support.examples import examples
from tests.unit.roswire.tables import rows

XML_TEXT = st.text(
    st.one_of(
        st.sampled_from("<>&'\"\r\n\t ]é\u4e2d\U0001f916"),
        st.characters(exclude_categories=["Cs"], exclude_characters="\ufffe\uffff", min_codepoint=32),
    ),
    max_size=20,
)
VALUES: st.SearchStrategy[Value] = st.recursive(
    st.one_of(
        st.booleans(),
        st.integers(-(2**31), 2**31 - 1),
        st.floats(allow_nan=False),
        XML_TEXT,
        st.binary(max_size=100),
        st.datetimes(timezones=st.none()).map(lambda moment: moment.replace(microsecond=0)),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=5), st.dictionaries(XML_TEXT, inner, max_size=5)),
    max_leaves=20,
)


def call(value: str) -> bytes:
    return (
        f"<methodCall><methodName>m</methodName><params><param>{value}</param></params></methodCall>".encode()
    )


def read(value: str, limits: XmlRpcLimits | None = None) -> Value:
    return parse_call(call(value), limits or XmlRpcLimits()).params[0]


def python_loads(body: bytes) -> tuple[tuple[Any, ...], str | None]:
    return xmlrpc.client.loads(body, use_builtin_types=True)  # noqa: TID251 - the oracle of these tests


def without_bare_returns(value: Value) -> Value:
    match value:
        case str():
            return value.replace("\r\n", "\n").replace("\r", "\n")
        case list():
            return [without_bare_returns(item) for item in value]
        case dict():
            return {str(without_bare_returns(key)): without_bare_returns(item) for key, item in value.items()}
    return value


# --- round trips ------------------------------------------------------------------------------------------


@given(params=st.lists(VALUES, max_size=4), method=st.from_regex(r"[A-Za-z_.]{1,20}", fullmatch=True))
def test_calls_are_read_as_python_reads_them(params: list[Value], method: str) -> None:
    body = build_call(method, params)
    assert parse_call(body) == MethodCall(method, tuple(params))
    assert python_loads(body) == (tuple(params), method)


@given(params=st.lists(VALUES, max_size=4))
@example(params=[{"\r": 1}])
def test_calls_of_python_are_read(params: list[Value]) -> None:
    body = xmlrpc.client.dumps(tuple(params), "m").encode()
    expected = [without_bare_returns(value) for value in params]
    if body.count(b"<name>") == xmlrpc.client.dumps(tuple(expected), "m").count("<name>"):
        assert list(parse_call(body).params) == expected


@given(value=VALUES)
def test_answers_are_read_as_python_reads_them(value: Value) -> None:
    body = build_response(value)
    assert parse_response(body) == value
    assert python_loads(body) == ((value,), None)


@given(code=st.integers(-(2**31), 2**31 - 1), text=XML_TEXT)
def test_faults_come_back(code: int, text: str) -> None:
    body = build_fault(code, text)
    with pytest.raises(FaultReceived) as fault:
        parse_response(body)
    assert (fault.value.code, fault.value.text) == (code, text)
    with pytest.raises(xmlrpc.client.Fault) as python_fault:
        python_loads(body)
    assert (python_fault.value.faultCode, python_fault.value.faultString) == (code, text)


@pytest.mark.parametrize("number", [math.inf, -math.inf, 1e308, 5e-324, -0.0, 1e16, 0.1])
def test_doubles_keep_every_bit(number: float) -> None:
    result = parse_response(build_response(number))
    assert isinstance(result, float)
    assert math.copysign(1, result) == math.copysign(1, number)
    assert result == number == python_loads(build_response(number))[0][0]


def test_nan_survives() -> None:
    for text in ("nan", "NaN", "-nan", "NAN"):
        assert math.isnan(read(f"<value><double>{text}</double></value>"))  # type: ignore[arg-type]  # it is a double
    assert b"<double>nan</double>" in build_response(math.nan)
    assert math.isnan(python_loads(build_response(math.nan))[0][0])


# --- what clients send ------------------------------------------------------------------------------------

# The form of roscpp's requests: no <string>, <i4>, line ends only around <params>.
ROSCPP_CALL = (
    b'<?xml version="1.0"?>\r\n<methodCall><methodName>registerSubscriber</methodName>\r\n<params>'
    b"<param><value>/listener</value></param><param><value>/chatter</value></param>"
    b"<param><value>std_msgs/String</value></param><param><value>http://h:4567/</value></param>"
    b"</params></methodCall>\r\n"
)


def test_roscpp_calls_are_read() -> None:
    expected = ("/listener", "/chatter", "std_msgs/String", "http://h:4567/")
    assert parse_call(ROSCPP_CALL) == MethodCall("registerSubscriber", expected)


@pytest.mark.parametrize(
    ("element", "expected"),
    [
        ("<value></value>", ""),
        ("<value/>", ""),
        ("<value>  </value>", "  "),
        ("<value> a b </value>", " a b "),
        ("<value><string/></value>", ""),
        ("<value><string> a </string></value>", " a "),
        ("<value>\n<int>1</int>\n</value>", 1),
        ("<value><i4> -7 </i4></value>", -7),
        ("<value><int>+2147483647</int></value>", 2147483647),
        ("<value><int>-2147483648</int></value>", -2147483648),
        ("<value><int>007</int></value>", 7),
        ("<value><boolean>1</boolean></value>", True),
        ("<value><boolean> 0 </boolean></value>", False),
        ("<value><double>1</double></value>", 1.0),
        ("<value><double> -1.5e-3 </double></value>", -0.0015),
        ("<value><double>.5</double></value>", 0.5),
        ("<value><double>5.</double></value>", 5.0),
        ("<value><double>-inf</double></value>", -math.inf),
        ("<value><double>Infinity</double></value>", math.inf),
        ("<value><nil/></value>", None),
        ("<value><base64>\nAAEC\n/w==\n</base64></value>", b"\x00\x01\x02\xff"),
        ("<value><base64></base64></value>", b""),
        (
            "<value><dateTime.iso8601>20250131T23:59:58</dateTime.iso8601></value>",
            datetime.datetime(2025, 1, 31, 23, 59, 58),  # noqa: DTZ001 - XML-RPC has no time zones
        ),
        ("<value><array><data></data></array></value>", []),
        ("<value><array><data/></array></value>", []),
        ("<value><array>\n<data>\n<value>a</value>\n</data>\n</array></value>", ["a"]),
        ("<value><struct/></value>", {}),
        ("<value><struct><member><name>a</name><value>b</value></member></struct></value>", {"a": "b"}),
        ("<value><struct><member><name> a/b </name><value/></member></struct></value>", {" a/b ": ""}),
        ("<value>&lt;&amp;&gt;&quot;&apos;&#65;&#x41;&#13;</value>", "<&>\"'AA\r"),
        ("<value><string><![CDATA[<a>&b]]></string></value>", "<a>&b"),
        ("<value>caf\u00e9 \u4e2d \U0001f916</value>", "caf\u00e9 \u4e2d \U0001f916"),
    ],
)
def test_values_as_ros_clients_write_them(element: str, expected: Value) -> None:
    value = read(element)
    assert value == expected
    assert type(value) is type(expected)


def test_rosjava_calls_are_read() -> None:
    """The namespace and extensions of Apache XML-RPC are read, within ROS's ranges."""
    namespace = "http://ws.apache.org/xmlrpc/namespaces/extensions"
    head = f'<?xml version="1.0" encoding="UTF-8"?><methodCall xmlns:ex="{namespace}">'
    values = "<value>/a</value>", "<value><ex:nil/></value>", "<value><ex:i8>7</ex:i8></value>"
    params = "".join(f"<param>{value}</param>" for value in values)
    body = f"{head}<methodName>setParam</methodName><params>{params}</params></methodCall>"
    assert parse_call(body.encode()) == MethodCall("setParam", ("/a", None, 7))
    with pytest.raises(ProtocolError, match="32 bits"):
        parse_call(body.replace(">7<", ">3000000000<").encode())
    answer = (
        f"<methodResponse xmlns:ex='{namespace}'><params><param>{values[0]}</param></params></methodResponse>"
    )
    assert parse_response(answer.encode()) == "/a"


def test_calls_without_parameters() -> None:
    assert parse_call(b"<methodCall><methodName>m</methodName></methodCall>") == MethodCall("m", ())
    assert parse_call(b"<methodCall><methodName>m</methodName><params/></methodCall>") == MethodCall("m", ())


@pytest.mark.parametrize(
    ("declaration", "body"),
    [
        ("<?xml version='1.0'?>\n", b"\xc3\xa9"),
        ('<?xml version="1.0" encoding="utf-8"?>', b"\xc3\xa9"),
        ('<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\r\n', b"\xc3\xa9"),
        ('<?xml version="1.0" encoding="ISO-8859-1"?>', b"\xe9"),
        ("\ufeff", b"\xc3\xa9"),
        ("\n  ", b"\xc3\xa9"),
    ],
)
def test_declarations_that_are_read(declaration: str, body: bytes) -> None:
    assert parse_call(declaration.encode() + call("<value>@</value>").replace(b"@", body)).params == (
        "\u00e9",
    )


# --- what is refused --------------------------------------------------------------------------------------

ENTITY_BOMB = (
    b'<?xml version="1.0"?><!DOCTYPE m [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>'
    + call("<value>&b;</value>")
)


@pytest.mark.parametrize(
    ("body", "text"),
    [
        *((call(value), why) for value, why in rows("values that are not XML-RPC")),
        (b"", "byte 0"),
        (b"hello", "byte 0"),
        (ENTITY_BOMB, "byte 0"),
        (b"<!-- a -->" + call("<value/>"), "byte 0"),
        (b"<?php a ?>" + call("<value/>"), "byte 0"),
        (b'<?xml version="1.1"?>' + call("<value/>"), "byte 0"),
        (b'<?xml version="1.0" encoding="UTF-16"?>' + call("<value/>"), "encoding UTF-16"),
        (b'<?xml version="1.0" encoding="utf-7"?>' + call("<value/>"), "encoding utf-7"),
        (b'<?xml version="1.0" encoding="cp037"?>' + call("<value/>"), "encoding cp037"),
        (call("<value/>").decode().encode("utf-16"), "byte 0"),
        (call("<value/>").decode().encode("utf-16-le"), "byte 0"),
        (b"<methodResponse></methodResponse>", "expected <methodCall>"),
        (b"<methodCall xmlns='a'><methodName>m</methodName></methodCall>", "byte 0"),
        (b"<methodCall></methodCall>", "too early"),
        (b"<methodCall><params/></methodCall>", "<params> inside methodCall"),
        (b"<methodCall><methodName>a</methodName><methodName>b</methodName></methodCall>", "<methodName>"),
        (b"<methodCall><methodName>a<b/></methodName></methodCall>", "<b> inside methodName"),
        (call("<value/>") + call("<value/>"), "well-formed"),
        (call("<value/>") + b"x", "well-formed"),
        (call("<value/>") + b"<?a b?>", "processing instruction"),
        (call(""), "too early"),
        (b"<methodCall xmlns:ex='urn:other'><methodName>m</methodName></methodCall>", "byte 0"),
        (call("<value>@</value>").replace(b"@", b"\xff"), "well-formed"),
        (call("<value>@</value>").replace(b"@", b"\xed\xa0\x80"), "well-formed"),
        (call("<value>@</value>").replace(b"@", b"\xc0\xaf"), "well-formed"),
    ],
)
def test_invalid_xml_rpc_is_refused(body: bytes, text: str) -> None:
    with pytest.raises(ProtocolError, match=text) as refused:
        parse_call(body)
    assert "byte" in str(refused.value)
    assert str(refused.value).isprintable()


@pytest.mark.parametrize(
    "body",
    [
        b"<methodResponse><params/></methodResponse>",
        b"<methodResponse><params><param><value/></param><param><value/></param></params></methodResponse>",
        b"<methodResponse></methodResponse>",
        b"<methodResponse><fault><value>no</value></fault></methodResponse>",
        b"<methodResponse><fault><value><struct/></value></fault></methodResponse>",
        b"<methodResponse><params><param><value/></param></params><fault><value/></fault></methodResponse>",
        b"<methodCall><methodName>m</methodName></methodCall>",
    ],
)
def test_answers_that_are_refused(body: bytes) -> None:
    with pytest.raises(ProtocolError):
        parse_response(body)


def test_limits_hold() -> None:
    limits = XmlRpcLimits(body=2000, elements=4, depth=2, string=5, parts=2)
    array = "<value><array><data>{}</data></array></value>".format
    assert read(array(array("<value/>")), limits) == [[""]]
    assert read("<value>12345</value>", limits) == "12345"
    assert read(array("<value/>" * 3), limits) == ["", "", ""]
    for body, text in [
        (call(array(array(array("")))), "deeper than 2"),
        (call(array("<value/>" * 4)), "more than 4 values"),
        (call("<value>123456</value>"), "6 characters; at most 5"),
        (call("<value><base64>AAAAAAAA</base64></value>"), "8 characters; at most 5"),
        (call("<value>12345</value>") + b" " * 2000, "body of"),
    ]:
        with pytest.raises(LimitExceededError, match=text):
            parse_call(body, limits)


def test_parts_of_a_multicall_are_bounded() -> None:
    body = build_call("system.multicall", [["a"] * 3])
    assert len(parse_call(body, XmlRpcLimits(parts=3)).params) == 1
    with pytest.raises(LimitExceededError, match="3 calls; at most 2"):
        parse_call(body, XmlRpcLimits(parts=2))
    assert parse_call(build_call("setParam", [["a"] * 3]), XmlRpcLimits(parts=2)).params == (["a"] * 3,)


PREFIX = b"<methodCall><methodName>m</methodName><params><param>"


@pytest.mark.parametrize(
    ("body", "text"),
    [
        (PREFIX + b"<" + b"a" * 1_000_000 + b">", "a tag or comment of more than"),
        (PREFIX + b"<value " + b"".join(b"a%d='' " % number for number in range(100_000)) + b">", "tag"),
        (PREFIX + b"<a>" * 300_000, "<a> inside param"),
        (PREFIX + b"<value><array><data>" * 50_000, "deeper than 100"),
    ],
)
def test_large_documents_are_refused_where_they_go_wrong(body: bytes, text: str) -> None:
    with pytest.raises(ProtocolError, match=text):
        parse_call(body)


def test_large_values_in_pieces() -> None:
    value: Value = [{"a": "x\u00e9<&" * 30_000, "b": list(range(20_000))}, "\U0001f916" * 60_000]
    assert parse_call(build_call("m", [value])).params == (value,)


@pytest.mark.parametrize(
    "number",
    ["1" * 16_000 + "x", "1." + "1" * 16_000 + "x", "1" * 8_000 + " " * 8_000 + "x", " " * 16_000 + "x"],
    ids=["digits", "fraction", "space behind", "space before"],
)
@pytest.mark.parametrize("tag", ["double", "int", "base64", "dateTime.iso8601"])
def test_an_invalid_long_number_takes_linear_time(tag: str, number: str) -> None:
    begun = time.process_time()
    with pytest.raises(ProtocolError):
        read(f"<value><{tag}>{number}</{tag}></value>")
    assert time.process_time() - begun < 1.0  # a quadratic pattern takes seconds


# --- fuzz -------------------------------------------------------------------------------------------------

TAGS = [
    "methodCall", "methodResponse", "methodName", "params", "param", "fault", "value", "int", "i4", "boolean", "double",
    "string", "dateTime.iso8601", "base64", "nil", "array", "data", "struct", "member", "name",
]  # fmt: skip
SCRAPS = st.one_of(
    st.sampled_from([form.format(tag) for tag in TAGS for form in ("<{}>", "</{}>", "<{}/>", "<{} a='b'>")]),
    st.sampled_from([
        "<![CDATA[", "]]>", "<!--", "-->", "<?a?>", "<!DOCTYPE", "&amp;", "&#1;", "&a;", "1",
        "-5", "1e9", "AAAA", "\x00", "é", "<", ">", "&", "'",
    ]),
)  # fmt: skip


@settings(max_examples=examples(500))
@given(scraps=st.lists(SCRAPS, max_size=12), whole=st.booleans(), raw=st.binary(max_size=3))
def test_scraps_raise_only_the_error_for_the_peer(scraps: list[str], whole: bool, raw: bytes) -> None:
    text = "".join(scraps)
    body = (call(text) if whole else text.encode()).replace(b"-5", raw)
    for parse in (parse_call, parse_response):
        try:
            result = parse(body)
        except PeerError as error:
            assert str(error).isprintable()
        else:
            assert whole or isinstance(result, MethodCall) or "<methodResponse>" in text


@settings(max_examples=examples(300))
@given(data=st.data())
def test_damaged_calls_raise_only_the_error_for_the_peer(data: st.DataObject) -> None:
    body = bytearray(build_call("m", [data.draw(VALUES)]))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(body) - 1))
        piece = bytes(body[data.draw(st.integers(0, len(body) - 1)) :][: data.draw(st.integers(0, 30))])
        body[at : at + data.draw(st.integers(0, 8))] = data.draw(
            st.sampled_from([piece, b"", b"\xff", b"<", b"&"])
        )
        body = body or bytearray(b"<")
    try:
        parsed = parse_call(bytes(body))
    except PeerError:
        return
    assert repr((parsed.params, parsed.method)) == repr(python_loads(bytes(body)))


@given(data=st.binary(max_size=200))
def test_random_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(PeerError):
        parse_call(data)


# --- what is not written ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("a\x00", "no notation"),
        ("\x1b[0m", r"'\\x1b' at 0"),
        ("\ud800", "no notation"),
        ("\uffff", "no notation"),
        ({"a\x01": 1}, "no notation"),
        (2**31, "32 bits"),
        (-(2**31) - 1, "32 bits"),
        ([{"a": None}], "None"),
        ({1: 2}, "not a string"),
        ({1, 2}, "type set"),
        (datetime.datetime(2025, 1, 1, tzinfo=datetime.UTC), "time zones"),
    ],
)
def test_values_without_a_notation_are_errors(value: object, text: str) -> None:
    with pytest.raises(EncodingError, match=text):
        build_response(value)  # type: ignore[arg-type]  # the test is a value of a wrong type
    with pytest.raises(EncodingError, match=text):
        build_call("m", [value])  # type: ignore[list-item]  # as above


def test_endless_values_are_errors() -> None:
    endless: list[Value] = []
    endless.append(endless)
    with pytest.raises(EncodingError, match="deeper"):
        build_response(endless)


def test_texts_of_faults_are_always_sent() -> None:
    with pytest.raises(FaultReceived, match=r"fault 1: a\?<b>"):
        parse_response(build_fault(1, "a\x00<b>"))


def test_the_deepest_readable_value_can_be_written() -> None:
    depth = XmlRpcLimits().depth
    body = call("<value><array><data>" * depth + "</data></array></value>" * depth)
    assert parse_call(build_call("m", parse_call(body).params)) == parse_call(body)
