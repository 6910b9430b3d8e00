"""XML-RPC as ROS 1 speaks it, without I/O: bytes to values under limits, values to bytes.

Reading is a walk over one table, `_GRAMMAR`: what may stand in which element, in which order. Elements,
attributes, text between elements and values that the table or XML-RPC do not know are refused. Beside the
specification it takes what ROS clients send: values without a type (strings; XmlRpc++), `<nil/>`, `inf` and
`nan`, space around numbers, CDATA sections (rosnodejs).

Invariants:

1. The document starts with an optional XML declaration and the root element. So there is no document type,
   hence no entity but the five of XML, no external reference; processing instructions are refused anywhere.
2. One pass in time linear in the body; nothing is kept but values, and number, depth and size are bounded.
3. A value that `parse_*` returns has one notation: `build_*` of it is read back as the same value by us, by
   Python's `xmlrpc.client` (rosmaster, rospy) and, `\\r` apart, by XmlRpc++ (roscpp).
4. Every error of a parser is a `PeerError`; every error of a builder is an `EncodingError`.
"""

import binascii
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, TypeAlias
from xml.parsers import expat

from appliance.ros.errors import EncodingError, LimitExceededError, PeerError, ProtocolError

Value: TypeAlias = "bool | int | float | str | bytes | datetime | list[Value] | dict[str, Value] | None"
"""What a parameter or an answer of XML-RPC can be."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Upper bounds for one document; the defaults are beyond what a large robot sends."""

    body: int = 16 << 20  # bytes
    elements: int = 1_000_000  # values, those in arrays and structs included
    depth: int = 100  # nested arrays and structs
    string: int = 8 << 20  # characters of one string, bytes of one base64 value
    parts: int = 100_000  # calls in one system.multicall


DEFAULT_LIMITS = Limits()


@dataclass(frozen=True, slots=True)
class MethodCall:
    """A request: the name of the method, as it came, and its parameters."""

    method: str
    params: tuple[Value, ...]


class FaultReceived(PeerError):  # noqa: N818 - named as the event it is: the answer was a fault
    """The answer was a fault: the method could not be carried out."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(f"fault {code}: {text}")
        self.code = code
        self.text = text


def parse_call(body: bytes, limits: Limits = DEFAULT_LIMITS) -> MethodCall:
    """Parse a request; raises `ProtocolError` or `LimitExceededError`."""
    document = _Document(body, limits, "methodCall")
    params = document.values
    if document.method == "system.multicall" and params:
        parts = params[0]
        if isinstance(parts, list) and len(parts) > limits.parts:
            raise LimitExceededError(
                f"system.multicall of {len(parts)} calls; at most {limits.parts} are allowed"
            )
    return MethodCall(document.method, tuple(params))


def parse_response(body: bytes, limits: Limits = DEFAULT_LIMITS) -> Value:
    """Parse an answer; raises `FaultReceived` if it is a fault, `ProtocolError` or `LimitExceededError`."""
    document = _Document(body, limits, "methodResponse")
    if len(document.values) != 1:
        raise ProtocolError(f"answer with {len(document.values)} values; it has one")
    value = document.values[0]
    if not document.is_fault:
        return value
    if isinstance(value, dict):
        code, text = value.get("faultCode"), value.get("faultString")
        if type(code) is int and isinstance(text, str):
            raise FaultReceived(code, text)
    raise ProtocolError("fault without an integer faultCode and a string faultString")


def build_call(method: str, params: Sequence[Value]) -> bytes:
    """Write a request; raises `EncodingError` for what XML-RPC has no notation for."""
    out = ["<?xml version='1.0'?>\n<methodCall>\n<methodName>", _text(method), "</methodName>\n<params>\n"]
    for value in params:
        out.append("<param>\n")
        _write(value, out, 0)
        out.append("</param>\n")
    out.append("</params>\n</methodCall>\n")
    return "".join(out).encode()


def build_response(value: Value) -> bytes:
    """Write an answer; raises `EncodingError` for what XML-RPC has no notation for."""
    out = ["<?xml version='1.0'?>\n<methodResponse>\n<params>\n<param>\n"]
    _write(value, out, 0)
    out.append("</param>\n</params>\n</methodResponse>\n")
    return "".join(out).encode()


def build_fault(code: int, text: str) -> bytes:
    """Write a fault; characters of `text` that XML has no notation for are replaced by `?`."""
    out = ["<?xml version='1.0'?>\n<methodResponse>\n<fault>\n"]
    _write({"faultCode": code, "faultString": _NOT_XML.sub("?", text)}, out, 0)
    out.append("</fault>\n</methodResponse>\n")
    return "".join(out).encode()


# --- reading ----------------------------------------------------------------------------------------------

_HEAD = re.compile(
    rb"(?:\xef\xbb\xbf)?"
    rb"(?:<\?xml[ \t\r\n]+version[ \t\r\n]*=[ \t\r\n]*['\"]1\.0['\"]"
    rb"(?:[ \t\r\n]+encoding[ \t\r\n]*=[ \t\r\n]*['\"]([A-Za-z0-9._-]{1,40})['\"])?"
    rb"(?:[ \t\r\n]+standalone[ \t\r\n]*=[ \t\r\n]*['\"](?:yes|no)['\"])?[ \t\r\n]*\?>)?"
    rb"[ \t\r\n]*<([A-Za-z]{1,40})[ \t\r\n]*>"
)
_ENCODINGS = frozenset({b"utf-8", b"us-ascii", b"iso-8859-1"})
_SPACE = " \t\r\n"

_SCALARS = ("i4", "int", "boolean", "double", "string", "dateTime.iso8601", "base64", "nil")
_TYPES = (*_SCALARS, "array", "struct")

# Inside an element that is in this state, which child may start, and the state the element is in after it.
# An element starts in the state of its own name.
_GRAMMAR: Mapping[str, Mapping[str, str]] = {
    "document": {"methodCall": "full", "methodResponse": "full"},
    "methodCall": {"methodName": "methodCall, named"},
    "methodCall, named": {"params": "full"},
    "methodResponse": {"params": "full", "fault": "full"},
    "params": {"param": "params"},
    "param": {"value": "full"},
    "fault": {"value": "full"},
    "value": dict.fromkeys(_TYPES, "full"),
    "array": {"data": "full"},
    "data": {"value": "data"},
    "struct": {"member": "struct"},
    "member": {"name": "member, named"},
    "member, named": {"value": "full"},
    "full": {},
    "methodName": {},
    "name": {},
    **{tag: {} for tag in _SCALARS},
}
_INCOMPLETE = frozenset(
    {"methodCall", "methodResponse", "param", "fault", "array", "member", "member, named"}
)

_INTEGER = re.compile(r"[ \t\r\n]*([+-]?[0-9]{1,20})[ \t\r\n]*\Z")
_DOUBLE = re.compile(
    r"[ \t\r\n]*([+-]?(?:(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?|inf|infinity|nan))[ \t\r\n]*\Z",
    re.IGNORECASE | re.ASCII,
)
_DATE_TIME = re.compile(
    r"[ \t\r\n]*([0-9]{4})([0-9]{2})([0-9]{2})T([0-9]{2}):([0-9]{2}):([0-9]{2})[ \t\r\n]*\Z"
)
_BASE64 = re.compile(r"[A-Za-z0-9+/]*={0,2}\Z")
_NO_SPACE = str.maketrans("", "", _SPACE)


class _Document:
    """One document while it is read; afterwards `method`, `values` and `is_fault` are what was in it."""

    __slots__ = ("_depth", "_elements", "_expat", "_follow", "_keys", "_limits", "_stack", "_state", "_text",
                 "_value", "is_fault", "method", "values")  # fmt: skip

    def __init__(self, body: bytes, limits: Limits, root: str) -> None:
        _check_head(body, limits, root)
        self.method = ""
        self.values: list[Value] = []
        self.is_fault = False
        self._limits = limits
        self._state = "document"
        self._follow: list[str] = []  # the state each open element's parent goes on in
        self._text: list[str] = []
        self._value: Value = None  # the value that ended last
        self._stack: list[list[Value] | dict[str, Value]] = [self.values]  # open arrays and structs
        self._keys: list[str] = []  # open members
        self._elements = 0
        self._depth = 0
        parser = expat.ParserCreate()
        self._expat = parser
        parser.buffer_text = True
        parser.ordered_attributes = True
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.CharacterDataHandler = self._text.append
        parser.ProcessingInstructionHandler = self._refuse_instruction
        try:
            parser.Parse(body, True)
        except expat.ExpatError as error:
            what = expat.ErrorString(error.code)
            raise ProtocolError(f"not well-formed XML at byte {parser.ErrorByteIndex}: {what}") from None
        finally:
            del self._expat  # the parser refers to this object: no cycle is left behind

    def _start(self, tag: str, attributes: list[str]) -> None:
        follow = _GRAMMAR[self._state].get(tag)
        if follow is None or attributes:
            raise self._error(f"<{tag[:40]}> {'with attributes' if follow else f'inside {self._place()}'}")
        if self._text:
            self._refuse_text()
        self._follow.append(follow)
        self._state = tag
        if tag == "value":
            self._elements += 1
            if self._elements > self._limits.elements:
                raise LimitExceededError(f"more than {self._limits.elements} values in one document")
        elif tag == "array":
            self._open([])
        elif tag == "struct":
            self._open({})

    def _end(self, tag: str) -> None:
        if tag == "value":
            if self._state == "value":  # without a type
                self._value = self._string()
            elif self._text:
                self._refuse_text()
            container = self._stack[-1]
            if type(container) is list:
                container.append(self._value)
            else:
                container[self._keys.pop()] = self._value  # type: ignore[call-overload]  # it is the dict
        elif (read := _READ.get(tag)) is not None:
            self._value = read(self)
        elif self._text:
            self._refuse_text()
            self._close(tag)
        else:
            self._close(tag)
        self._state = self._follow.pop()

    def _close(self, tag: str) -> None:
        if self._state in _INCOMPLETE:
            raise self._error(f"</{tag}> too early: something is missing in it")
        if tag in ("array", "struct"):
            self._value = self._stack.pop()
            self._depth -= 1
        elif tag == "fault":
            self.is_fault = True

    def _open(self, container: list[Value] | dict[str, Value]) -> None:
        self._depth += 1
        if self._depth > self._limits.depth:
            raise LimitExceededError(f"arrays and structs nested deeper than {self._limits.depth}")
        self._stack.append(container)

    def _string(self) -> str:
        text = self._text
        if not text:
            return ""
        string = text[0] if len(text) == 1 else "".join(text)
        text.clear()
        if len(string) > self._limits.string:
            raise LimitExceededError(
                f"string of {len(string)} characters; at most {self._limits.string} are allowed"
            )
        return string

    def _method_name(self) -> None:
        self.method = self._string()

    def _member_name(self) -> None:
        key = self._string()
        if key in self._stack[-1]:
            raise self._error(f"struct with two members {key[:80]!a}")
        self._keys.append(key)

    def _integer(self) -> int:
        text = self._string()
        found = _INTEGER.match(text)
        if found is None:
            raise self._error(f"integer {text[:40]!a}")
        number = int(found[1])
        if not -0x80000000 <= number <= 0x7FFFFFFF:
            raise self._error(f"integer {text[:40]!a}: XML-RPC integers have 32 bits")
        return number

    def _boolean(self) -> bool:
        text = self._string().strip(_SPACE)
        if text not in ("0", "1"):
            raise self._error(f"boolean {text[:40]!a}: it is 0 or 1")
        return text == "1"

    def _double(self) -> float:
        text = self._string()
        found = _DOUBLE.match(text)
        if found is None:
            raise self._error(f"double {text[:40]!a}")
        return float(found[1])

    def _date_time(self) -> datetime:
        text = self._string()
        found = _DATE_TIME.match(text)
        try:
            if found is not None:
                year, month, day, hour, minute, second = map(int, found.groups())
                return datetime(year, month, day, hour, minute, second)  # noqa: DTZ001 - XML-RPC has no time zones
        except ValueError:
            pass
        raise self._error(f"dateTime.iso8601 {text[:40]!a}: it is written 20250131T23:59:59")

    def _base64(self) -> bytes:
        text = self._string().translate(_NO_SPACE)
        if len(text) % 4 or _BASE64.match(text) is None:
            raise self._error(f"base64 {text[:40]!a}")
        return binascii.a2b_base64(text)

    def _nil(self) -> None:
        if self._string().strip(_SPACE):
            raise self._error("text in <nil/>")

    def _place(self) -> str:
        return self._state if self._state != "full" else "an element that is complete"

    def _refuse_text(self) -> None:
        text = self._string().strip(_SPACE)
        if text:
            raise self._error(f"text {text[:40]!a} between elements")

    def _refuse_instruction(self, target: str, _data: str) -> None:
        raise self._error(f"processing instruction <?{target[:40]}")

    def _error(self, what: str) -> ProtocolError:
        return ProtocolError(f"not XML-RPC at byte {self._expat.CurrentByteIndex}: {what}")


_READ: Mapping[str, Callable[[_Document], Value]] = {
    "string": _Document._string,
    "int": _Document._integer,
    "i4": _Document._integer,
    "boolean": _Document._boolean,
    "double": _Document._double,
    "dateTime.iso8601": _Document._date_time,
    "base64": _Document._base64,
    "nil": _Document._nil,
    "name": _Document._member_name,
    "methodName": _Document._method_name,
}


def _check_head(body: bytes, limits: Limits, root: str) -> None:
    if len(body) > limits.body:
        raise LimitExceededError(f"body of {len(body)} bytes; at most {limits.body} are allowed")
    head = _HEAD.match(body)
    if head is None:
        raise ProtocolError(
            "not XML-RPC at byte 0: a document starts with an XML declaration (version 1.0) or its root "
            "element; it has no DOCTYPE, comment or processing instruction and is not in UTF-16"
        )
    encoding, found = head[1], head[2].decode()
    if encoding is not None and encoding.lower() not in _ENCODINGS:
        raise ProtocolError(f"encoding {encoding.decode()} at byte {head.start(1)}; write UTF-8")
    if found != root:
        raise ProtocolError(f"<{found}> at byte {head.start(2) - 1}; expected <{root}>")


# --- writing ----------------------------------------------------------------------------------------------

_NOT_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")
_MAX_WRITE_DEPTH = 200  # well below Python's own limit, far above what is read


def _text(string: str) -> str:
    if not string.isprintable():
        bad = _NOT_XML.search(string)
        if bad is not None:
            raise EncodingError(
                f"string with {bad[0]!a} at {bad.start()}: XML has no notation for this character"
            )
    if "&" in string:
        string = string.replace("&", "&amp;")
    if "<" in string:
        string = string.replace("<", "&lt;")
    if ">" in string:
        string = string.replace(">", "&gt;")
    if "\r" in string:
        string = string.replace("\r", "&#13;")  # a bare one is read back as a line feed
    return string


def _write(value: Value, out: list[str], depth: int) -> None:
    if depth > _MAX_WRITE_DEPTH:
        raise EncodingError(f"value nested deeper than {_MAX_WRITE_DEPTH}")
    writer = _WRITERS.get(type(value))
    if writer is None:
        raise EncodingError(f"value of type {type(value).__name__}: XML-RPC has no notation for it")
    writer(value, out, depth)


def _write_string(value: str, out: list[str], _depth: int) -> None:
    out.append(f"<value><string>{_text(value)}</string></value>\n")


def _write_boolean(value: bool, out: list[str], _depth: int) -> None:
    out.append("<value><boolean>1</boolean></value>\n" if value else "<value><boolean>0</boolean></value>\n")


def _write_integer(value: int, out: list[str], _depth: int) -> None:
    if not -0x80000000 <= value <= 0x7FFFFFFF:
        raise EncodingError(f"integer {value}: XML-RPC integers have 32 bits")
    out.append(f"<value><int>{value}</int></value>\n")


def _write_double(value: float, out: list[str], _depth: int) -> None:
    out.append(f"<value><double>{value!r}</double></value>\n")


def _write_date_time(value: datetime, out: list[str], _depth: int) -> None:
    if value.tzinfo is not None or value.microsecond:
        raise EncodingError(f"time {value}: XML-RPC has whole seconds and no time zones")
    text = (
        f"{value.year:04}{value.month:02}{value.day:02}T{value.hour:02}:{value.minute:02}:{value.second:02}"
    )
    out.append(f"<value><dateTime.iso8601>{text}</dateTime.iso8601></value>\n")


def _write_base64(value: bytes, out: list[str], _depth: int) -> None:
    out.append(f"<value><base64>\n{binascii.b2a_base64(value).decode()}</base64></value>\n")


def _write_array(value: Sequence[Value], out: list[str], depth: int) -> None:
    out.append("<value><array><data>\n")
    for item in value:
        _write(item, out, depth + 1)
    out.append("</data></array></value>\n")


def _write_struct(value: Mapping[str, Value], out: list[str], depth: int) -> None:
    out.append("<value><struct>\n")
    for key, item in value.items():
        if not isinstance(key, str):
            raise EncodingError(f"struct member {key!a}: its name is not a string")
        out.append(f"<member>\n<name>{_text(key)}</name>\n")
        _write(item, out, depth + 1)
        out.append("</member>\n")
    out.append("</struct></value>\n")


def _write_nil(_value: None, _out: list[str], _depth: int) -> None:
    raise EncodingError("None: ROS has no notation for it (roscpp and rosmaster cannot read or send <nil/>)")


_WRITERS: Mapping[type, Callable[[Any, list[str], int], None]] = {
    str: _write_string,
    bool: _write_boolean,
    int: _write_integer,
    float: _write_double,
    datetime: _write_date_time,
    bytes: _write_base64,
    list: _write_array,
    tuple: _write_array,
    dict: _write_struct,
    type(None): _write_nil,
}
