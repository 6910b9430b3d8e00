"""Parse an XML-RPC document into values, under limits.

The parser follows the table `_GRAMMAR`, and rejects everything else. It also accepts some forms outside the
specification, because ROS clients send them: values without a type (strings; XmlRpc++), `<nil/>`, `inf` and `nan`,
space around numbers, CDATA sections (rosnodejs), and the extensions of Apache XML-RPC (rosjava). Invariants:

1. A document type and processing instructions are rejected, so only the five entities of XML exist, and there are no
   external references.
2. The parser takes one pass, in linear time, and stores only values, whose number, depth and size are bounded.
3. Every error is a `PeerError`. It names the byte offset, except for `LimitExceededError`.
"""

import binascii
import re
from collections.abc import Callable, Mapping
from datetime import datetime
from xml.parsers import expat

from roswire.counted import counted
from roswire.errors import LimitExceededError, ProtocolError
from roswire.xmlrpc.xmlrpc_values import Value, XmlRpcLimits

_HEAD = re.compile(
    rb"(?:\xef\xbb\xbf)?"
    rb"(?:<\?xml[ \t\r\n]++version[ \t\r\n]*+=[ \t\r\n]*+['\"]1\.0['\"]"
    rb"(?:[ \t\r\n]++encoding[ \t\r\n]*+=[ \t\r\n]*+['\"]([A-Za-z0-9._-]{1,40}+)['\"])?"
    rb"(?:[ \t\r\n]++standalone[ \t\r\n]*+=[ \t\r\n]*+['\"](?:yes|no)['\"])?[ \t\r\n]*+\?>)?"
    rb"[ \t\r\n]*+<([A-Za-z]{1,40}+)"
    # rosjava (Apache XML-RPC) always declares its extensions
    rb"(?:[ \t\r\n]++xmlns:ex=['\"]http://ws\.apache\.org/xmlrpc/namespaces/extensions['\"])?[ \t\r\n]*+>"
)
_LONGEST_HEAD = 4096
_ENCODINGS = frozenset({b"utf-8", b"us-ascii", b"iso-8859-1"})
_SPACE = " \t\r\n"
_LINE_FEED = ["\n"]

_SCALARS = ("i4", "int", "boolean", "double", "string", "dateTime.iso8601", "base64", "nil",
            "ex:i1", "ex:i2", "ex:i8", "ex:float", "ex:nil")  # fmt: skip
_TYPES = (*_SCALARS, "array", "struct")

# For each state of an element: the children that may start, and the element's state after each child. An element starts
# in the state with its own name.
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

_INTEGER = re.compile(r"[ \t\r\n]*+([+-]?[0-9]{1,20}+)[ \t\r\n]*+\Z")
_DOUBLE = re.compile(
    r"[ \t\r\n]*+([+-]?(?:(?:[0-9]++(?:\.[0-9]*+)?|\.[0-9]++)(?:[eE][+-]?[0-9]++)?|inf|infinity|nan))[ \t\r\n]*+\Z",
    re.IGNORECASE | re.ASCII,
)
_DATE_TIME = re.compile(
    r"[ \t\r\n]*+([0-9]{4})([0-9]{2})([0-9]{2})T([0-9]{2}):([0-9]{2}):([0-9]{2})[ \t\r\n]*+\Z"
)
_LONGEST_SCALAR = 4096  # characters of a number, boolean or time: any double in full, with space around it
_PIECE = 64 << 10  # the number of bytes given to expat at once
_NO_SPACE = str.maketrans("", "", _SPACE)


class XmlRpcDocument:
    """Parses a document. Afterwards, `method`, `values` and `is_fault` have its contents."""

    __slots__ = ("_depth", "_elements", "_expat", "_follow", "_keys", "_limits", "_stack", "_state", "_text",
                 "_value", "is_fault", "method", "values")  # fmt: skip

    def __init__(self, body: bytes, limits: XmlRpcLimits, root: str) -> None:
        _check_head(body, limits, root)
        self.method = ""
        self.values: list[Value] = []
        self.is_fault = False
        self._limits = limits
        self._state = "document"
        self._follow: list[str] = []  # for each open element: the next state of its parent
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
            self._parse(body)
        except expat.ExpatError as error:
            what = expat.ErrorString(error.code)
            raise ProtocolError(f"not well-formed XML at byte {parser.ErrorByteIndex}: {what}") from None
        finally:
            del self._expat  # the parser refers to this object; this breaks the cycle

    def _parse(self, body: bytes) -> None:
        """Feed the parser in pieces, and reject a tag that is longer than a piece.

        When a handler raises, expat still reads the rest of its piece and keeps a stack of the elements there. It
        scans an unfinished tag again with the next piece, and collects the attributes of a tag. Small pieces and
        short tags bound this work.
        """
        parser = self._expat
        if len(body) <= _PIECE:
            parser.Parse(body, True)
            return
        view = memoryview(body)
        for start in range(0, len(body), _PIECE):
            piece = view[start : start + _PIECE]
            parser.Parse(piece, False)
            if start + len(piece) - parser.CurrentByteIndex > _PIECE:
                raise self._error(f"a tag or comment of more than {_PIECE} bytes")
        parser.Parse(b"", True)

    def _start(self, tag: str, attributes: list[str]) -> None:
        follow = _GRAMMAR[self._state].get(tag)
        if follow is None or (attributes and self._state != "document"):  # _HEAD has the root's attributes
            raise self._error(f"<{tag[:40]}> {'with attributes' if follow else f'inside {self._place()}'}")
        if self._text:
            self._pass_space()
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
            if self._state == "value":  # a value without a type
                self._value = self._string()
            elif self._text:
                self._pass_space()
            container = self._stack[-1]
            if type(container) is list:
                container.append(self._value)
            else:
                container[self._keys.pop()] = self._value  # type: ignore[call-overload]  # the container is the dict
        elif (read := _READ.get(tag)) is not None:
            self._value = read(self)
        else:
            if self._text:
                self._pass_space()
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
                f"string of {counted(len(string), 'character')}; at most {self._limits.string} are allowed"
            )
        return string

    def _scalar(self) -> str:
        """Return the text of a scalar. Its length is limited because a pattern match cannot be interrupted."""
        text = self._string()
        if len(text) > _LONGEST_SCALAR:
            raise self._error(
                f"<{self._state}> with {counted(len(text), 'character')}; at most {_LONGEST_SCALAR} are allowed"
            )
        return text

    def _method_name(self) -> None:
        self.method = self._string()

    def _member_name(self) -> None:
        key = self._string()
        if key in self._stack[-1]:
            raise self._error(f"struct with two members {key[:80]!a}")
        self._keys.append(key)

    def _integer(self) -> int:
        text = self._scalar()
        match = _INTEGER.match(text)
        if match is None:
            raise self._error(f"integer {text[:40]!a}")
        number = int(match[1])
        if not -0x80000000 <= number <= 0x7FFFFFFF:
            raise self._error(f"integer {text[:40]!a}: XML-RPC integers have 32 bits")
        return number

    def _boolean(self) -> bool:
        text = self._scalar().strip(_SPACE)
        if text not in ("0", "1"):
            raise self._error(f"boolean {text[:40]!a}: it is 0 or 1")
        return text == "1"

    def _double(self) -> float:
        text = self._scalar()
        match = _DOUBLE.match(text)
        if match is None:
            raise self._error(f"double {text[:40]!a}")
        return float(match[1])

    def _date_time(self) -> datetime:
        text = self._scalar()
        match = _DATE_TIME.match(text)
        try:
            if match is not None:
                year, month, day, hour, minute, second = map(int, match.groups())
                return datetime(year, month, day, hour, minute, second)  # noqa: DTZ001 - XML-RPC has no time zones
        except ValueError:
            pass
        raise self._error(f"dateTime.iso8601 {text[:40]!a}: it is written 20250131T23:59:59")

    def _base64(self) -> bytes:
        text = self._string().translate(_NO_SPACE)
        try:
            return binascii.a2b_base64(text, strict_mode=True)
        except ValueError:
            raise self._error(f"base64 {text[:40]!a}") from None

    def _nil(self) -> None:
        if self._scalar().strip(_SPACE):
            raise self._error("text in <nil/>")

    def _place(self) -> str:
        return self._state if self._state != "full" else "an element that is complete"

    def _pass_space(self) -> None:
        if self._text != _LINE_FEED:
            text = "".join(self._text).strip(_SPACE)
            if text:
                raise self._error(f"text {text[:40]!a} between elements")
        self._text.clear()

    def _refuse_instruction(self, target: str, _data: str) -> None:
        raise self._error(f"processing instruction <?{target[:40]}")

    def _error(self, what: str) -> ProtocolError:
        return ProtocolError(f"not XML-RPC at byte {self._expat.CurrentByteIndex}: {what}")


_READ: Mapping[str, Callable[[XmlRpcDocument], Value]] = {
    "string": XmlRpcDocument._string,
    "int": XmlRpcDocument._integer,
    "i4": XmlRpcDocument._integer,
    "boolean": XmlRpcDocument._boolean,
    "double": XmlRpcDocument._double,
    "dateTime.iso8601": XmlRpcDocument._date_time,
    "base64": XmlRpcDocument._base64,
    "nil": XmlRpcDocument._nil,
    "ex:i1": XmlRpcDocument._integer,
    "ex:i2": XmlRpcDocument._integer,
    "ex:i8": XmlRpcDocument._integer,
    "ex:float": XmlRpcDocument._double,
    "ex:nil": XmlRpcDocument._nil,
    "name": XmlRpcDocument._member_name,
    "methodName": XmlRpcDocument._method_name,
}


def _check_head(body: bytes, limits: XmlRpcLimits, root: str) -> None:
    if len(body) > limits.body:
        raise LimitExceededError(f"body of {len(body)} bytes; at most {limits.body} are allowed")
    head = _HEAD.match(body, 0, _LONGEST_HEAD)
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
