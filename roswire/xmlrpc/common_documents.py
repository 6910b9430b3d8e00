"""Parse requests and answers, with a fast path for common ones: names, numbers, and lists of both.

On the fast path, one pattern matches the whole document, or each part of a multicall. It accepts a subset of the
documents that `xmlrpc_reader` accepts, with the same values. Strings are printable ASCII that needs no XML escapes.
`xmlrpc_reader` parses all other documents and reports all errors. It also parses a complex part of a multicall, so
that the other parts stay on the fast path.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace

from roswire.counted import counted
from roswire.errors import LimitExceededError, PeerError, ProtocolError
from roswire.xmlrpc.xmlrpc_reader import XmlRpcDocument
from roswire.xmlrpc.xmlrpc_values import DEFAULT_LIMITS, Value, XmlRpcLimits

_LONGEST = 32 << 10  # the maximum number of bytes for one pattern
_MAX_ALONE = 256  # the maximum number of parts left to `xmlrpc_reader`, which take twice as long
_SMALLEST = len("<value></value>")
# Every repeat of a set is possessive (`*+`), so time is linear in the document.
_SPACE = rb"[ \t\r\n]*+"
_TEXT = rb"[ -%'-;=?-~]*+"
_INTEGER = rb"-?[0-9]{1,9}+"
_DOUBLE = rb"-?[0-9]++(?:\.[0-9]++)?(?:e[-+]?[0-9]++)?"


def _scalar(group: bytes = b"(?:") -> bytes:
    kinds = (
        (b"string", _TEXT), (b"int", _INTEGER), (b"i4", _INTEGER), (b"boolean", b"[01]"), (b"double", _DOUBLE)
    )  # fmt: skip
    typed = [b"<%b>%b%b)</%b>" % (kind, group, content, kind) for kind, content in kinds]
    return b"<value>(?:%b|%b%b))</value>" % (b"|".join(typed), group, _TEXT)


_ONE = _scalar()
_EACH = b"(?:" + _ONE + _SPACE + b")*"
_ARRAY, _END = b"<value><array><data>" + _SPACE, b"</data></array></value>" + _SPACE
_DECLARED = rb"<\?xml version=(?:'1\.0'|\"1\.0\")\?>"


def _spaced_pattern(*parts: bytes) -> re.Pattern[bytes]:
    return re.compile(_SPACE.join([*parts, b""]))


def _list_in(group: bytes) -> bytes:
    each = group + _EACH + b")"
    return _ARRAY + each + b"(?:" + _ARRAY + each + _END + b")?" + _END


_LIST = _list_in(b"(")
_CALL = _spaced_pattern(
    _DECLARED, b"<methodCall>", rb"<methodName>([A-Za-z.]++)</methodName>", b"<params>",
    b"((?:<param>" + _SPACE + _ONE + _SPACE + b"</param>" + _SPACE + b")*)</params>", b"</methodCall>", rb"\Z",
)  # fmt: skip
_CALLS = _spaced_pattern(
    _DECLARED,
    b"<methodCall>",
    rb"<methodName>system\.multicall</methodName>",
    b"<params>",
    b"<param>",
    _ARRAY,
)
_NAME = _SPACE.join(
    [b"<member>", b"<name>methodName</name>", b"<value><string>([A-Za-z]++)</string></value>"]
)
_CALL_IN = _spaced_pattern(
    b"<value><struct>", _NAME, b"</member>", b"<member>", b"<name>params</name>", _LIST, b"</member>",
    b"</struct></value>",
)  # fmt: skip
_CALLS_END = _spaced_pattern(_END, b"</param>", b"</params>", b"</methodCall>", rb"\Z")
_ANSWER_HEAD = _DECLARED, b"<methodResponse>", b"<params>", b"<param>"
_ANSWER_END = b"</param>", b"</params>", b"</methodResponse>", rb"\Z"
_ANSWER = _spaced_pattern(*_ANSWER_HEAD, _LIST, *_ANSWER_END)
_ANSWERS, _ANSWERS_END = _spaced_pattern(*_ANSWER_HEAD, _ARRAY), _spaced_pattern(_END, *_ANSWER_END)
_ANSWER_IN = _spaced_pattern(_ARRAY + _LIST + _END)
_VALUE = re.compile(_scalar(b"("))
_STRUCT, _STRUCT_TAG = b"<value><struct>", re.compile(b"</?struct>")
_ALONE = b"<methodResponse><params><param>%b</param></params></methodResponse>"
_STRUCT_END = re.compile(b"</struct>" + _SPACE + b"</value>" + _SPACE)


def read_common_call(body: bytes, limits: XmlRpcLimits) -> tuple[str, list[Value]] | None:
    """Return the method and its parameters (of a multicall: of all parts), or None unless all are scalars."""
    if not _fits(body, limits):
        return None
    match = _CALL.match(body) if len(body) <= _LONGEST else None
    if match is not None:
        return match[1].decode(), _values(match[2])
    calls = _several(body, limits, (_CALLS, _CALL_IN, _CALLS_END), _call)
    return None if calls is None else ("system.multicall", [calls])


def read_common_answer(body: bytes, limits: XmlRpcLimits) -> list[Value] | None:
    """Return the answers, or None unless each is a list of scalars, of which the last may be a list of scalars."""
    if not _fits(body, limits):
        return None
    match = _ANSWER.match(body) if len(body) <= _LONGEST else None
    if match is not None:
        return _list(*match.groups())
    return _several(body, limits, (_ANSWERS, _ANSWER_IN, _ANSWERS_END), _answer)


def _several(
    body: bytes,
    limits: XmlRpcLimits,
    patterns: tuple[re.Pattern[bytes], re.Pattern[bytes], re.Pattern[bytes]],
    read: Callable[[re.Match[bytes]], Value],
) -> list[Value] | None:
    """Return the parts of a document, or None unless it has at least one part and nothing else."""
    head, part, end = patterns
    found = head.match(body)
    if found is None:
        return None
    at, values, left = found.end(), list[Value](), _MAX_ALONE
    try:
        while left and not (values and end.match(body, at)):
            found = part.match(body, at, at + _LONGEST)
            left -= found is None
            value, at = _struct(body, at, limits) if found is None else (read(found), found.end())
            values.append(value)
    except PeerError:
        return None
    return values if left else None


def _struct(body: bytes, begin: int, limits: XmlRpcLimits) -> tuple[Value, int]:
    """Return a part as `xmlrpc_reader` parses it, and the position of its end. Raise `PeerError` unless a struct.

    A value that is valid alone in a document is also valid in any other position one level deeper.
    """
    depth, end = 0, None
    for tag in _STRUCT_TAG.finditer(body, begin) if body.startswith(_STRUCT, begin) else ():
        depth += 1 if tag[0] == b"<struct>" else -1
        if not depth:
            end = _STRUCT_END.match(body, tag.start())
            break
    if end is None:
        raise ProtocolError("no struct")
    alone = _ALONE % body[begin : end.end()]
    values = XmlRpcDocument(alone, replace(limits, depth=limits.depth - 1), "methodResponse").values
    if len(values) != 1:
        raise ProtocolError("not one struct")
    return values[0], end.end()


def _call(part: re.Match[bytes]) -> Value:
    return {"methodName": part[1].decode(), "params": _list(part[2], part[3])}


def _answer(part: re.Match[bytes]) -> Value:
    return [_list(*part.groups())]


def _fits(body: bytes, limits: XmlRpcLimits) -> bool:
    return len(body) <= min(limits.body, limits.string, _SMALLEST * limits.elements) and limits.depth > 3


def _list(most: bytes, last: bytes | None) -> list[Value]:
    return _values(most) if last is None else [*_values(most), _values(last)]


def _values(text: bytes) -> list[Value]:
    return [
        (string or untyped).decode()
        if string or not (whole or four or boolean or double)
        else int(whole or four)
        if whole or four
        else float(double)
        if double
        else boolean == b"1"
        for string, whole, four, boolean, double, untyped in _VALUE.findall(text)
    ]


@dataclass(frozen=True, slots=True)
class MethodCall:
    """A call. `method` is as received, not checked."""

    method: str
    params: tuple[Value, ...]


class FaultReceived(PeerError):  # noqa: N818 - named as the event it is: the answer was a fault
    """The answer is a fault: the method failed."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(f"fault {code}: {text}")
        self.code = code
        self.text = text


def parse_call(body: bytes, limits: XmlRpcLimits = DEFAULT_LIMITS) -> MethodCall:
    """Return the call in a request. Raise `ProtocolError` or `LimitExceededError`."""
    parsed = read_common_call(body, limits)
    if parsed is None:
        document = XmlRpcDocument(body, limits, "methodCall")
        parsed = document.method, document.values
    method, params = parsed
    if method == "system.multicall" and params:
        parts = params[0]
        if isinstance(parts, list) and len(parts) > limits.parts:
            raise LimitExceededError(
                f"system.multicall of {counted(len(parts), 'call')}; at most {limits.parts} are allowed"
            )
    return MethodCall(method, tuple(params))


def parse_response(body: bytes, limits: XmlRpcLimits = DEFAULT_LIMITS) -> Value:
    """Return the value of an answer. Raise `FaultReceived` for a fault, `ProtocolError` or `LimitExceededError`."""
    parsed = read_common_answer(body, limits)
    if parsed is not None:
        return parsed
    document = XmlRpcDocument(body, limits, "methodResponse")
    if len(document.values) != 1:
        raise ProtocolError(f"answer with {counted(len(document.values), 'value')}; it has one")
    value = document.values[0]
    if not document.is_fault:
        return value
    if isinstance(value, dict):
        code, text = value.get("faultCode"), value.get("faultString")
        if type(code) is int and isinstance(text, str):
            raise FaultReceived(code, text)
    raise ProtocolError("fault without an integer faultCode and a string faultString")
