"""Reading the documents that a ROS network is full of: names, numbers and lists of them, as its clients write them.

One pattern has the whole document, or each part of a multicall, where `reader` walks through its elements. It takes
nothing that `reader` would not take, and as the same values; what it does not know, whatever may be in it, is left to
`reader`, which also has all errors. A part that is another struct is left to it alone: one long text among thousands of
parameters costs no other. Texts are printable ASCII without a character that means something in XML.
"""

import re
from collections.abc import Callable
from dataclasses import replace

from roswire.errors import PeerError, ProtocolError
from roswire.xmlrpc.xmlrpc_reader import Document
from roswire.xmlrpc.xmlrpc_values import Limits, Value

_LONGEST = 32 << 10  # bytes that one pattern has
_MOST_ALONE = 256  # parts that are walked alone: if all are, that takes twice as long as one walk
_SMALLEST = len("<value></value>")
# Of two stars that can take the same byte one gives nothing back (`*+`): time is linear in the document.
_SPACE = rb"[ \t\r\n]*+"
_TEXT = rb"[ -%'-;=?-~]*+"
_INTEGER = rb"-?[0-9]{1,9}"
_DOUBLE = rb"-?[0-9]++(?:\.[0-9]++)?(?:e[-+]?[0-9]++)?"


def _scalar(group: bytes = b"(?:") -> bytes:
    """A scalar; what begins the group of each kind of content."""
    kinds = (
        (b"string", _TEXT), (b"int", _INTEGER), (b"i4", _INTEGER), (b"boolean", b"[01]"), (b"double", _DOUBLE)
    )  # fmt: skip
    typed = [b"<%b>%b%b)</%b>" % (kind, group, content, kind) for kind, content in kinds]
    return b"<value>(?:%b|%b%b))</value>" % (b"|".join(typed), group, _TEXT)


_ONE = _scalar()
_EACH = b"(?:" + _ONE + _SPACE + b")*"
_ARRAY, _END = b"<value><array><data>" + _SPACE, b"</data></array></value>" + _SPACE
_DECLARED = rb"<\?xml version=(?:'1\.0'|\"1\.0\")\?>"


def _spaced(*parts: bytes) -> re.Pattern[bytes]:
    return re.compile(_SPACE.join([*parts, b""]))


def _list_in(group: bytes) -> bytes:
    """A list of scalars whose last may be such a list; what begins a group of each."""
    each = group + _EACH + b")"
    return _ARRAY + each + b"(?:" + _ARRAY + each + _END + b")?" + _END


_LIST = _list_in(b"(")
_CALL = _spaced(
    _DECLARED, b"<methodCall>", rb"<methodName>([A-Za-z.]+)</methodName>", b"<params>",
    b"((?:<param>" + _SPACE + _ONE + _SPACE + b"</param>" + _SPACE + b")*)</params>", b"</methodCall>", rb"\Z",
)  # fmt: skip
_CALLS = _spaced(
    _DECLARED,
    b"<methodCall>",
    rb"<methodName>system\.multicall</methodName>",
    b"<params>",
    b"<param>",
    _ARRAY,
)
_NAME = _SPACE.join([b"<member>", b"<name>methodName</name>", b"<value><string>([A-Za-z]+)</string></value>"])
_CALL_IN = _spaced(
    b"<value><struct>", _NAME, b"</member>", b"<member>", b"<name>params</name>", _LIST, b"</member>",
    b"</struct></value>",
)  # fmt: skip
_CALLS_END = _spaced(_END, b"</param>", b"</params>", b"</methodCall>", rb"\Z")
_ANSWER_HEAD = _DECLARED, b"<methodResponse>", b"<params>", b"<param>"
_ANSWER_END = b"</param>", b"</params>", b"</methodResponse>", rb"\Z"
_ANSWER = _spaced(*_ANSWER_HEAD, _LIST, *_ANSWER_END)
_ANSWERS, _ANSWERS_END = _spaced(*_ANSWER_HEAD, _ARRAY), _spaced(_END, *_ANSWER_END)
_ANSWER_IN = _spaced(_ARRAY + _LIST + _END)
_VALUE = re.compile(_scalar(b"("))
_STRUCT, _STRUCT_TAG = b"<value><struct>", re.compile(b"</?struct>")
_ALONE = b"<methodResponse><params><param>%b</param></params></methodResponse>"
_STRUCT_END = re.compile(b"</struct>" + _SPACE + b"</value>" + _SPACE)


def usual_call(body: bytes, limits: Limits) -> tuple[str, list[Value]] | None:
    """The method and the parameters of a call, if they are scalars, or those of all parts of a multicall; else None."""
    if not _fits(body, limits):
        return None
    found = _CALL.match(body) if len(body) <= _LONGEST else None
    if found is not None:
        return found[1].decode(), _values(found[2])
    calls = _several(body, limits, (_CALLS, _CALL_IN, _CALLS_END), _call)
    return None if calls is None else ("system.multicall", [calls])


def usual_answer(body: bytes, limits: Limits) -> list[Value] | None:
    """The answer, if it is a list of scalars whose last may be such a list, or several of a multicall's."""
    if not _fits(body, limits):
        return None
    found = _ANSWER.match(body) if len(body) <= _LONGEST else None
    if found is not None:
        return _list(*found.groups())
    return _several(body, limits, (_ANSWERS, _ANSWER_IN, _ANSWERS_END), _answer)


def _several(
    body: bytes,
    limits: Limits,
    patterns: tuple[re.Pattern[bytes], re.Pattern[bytes], re.Pattern[bytes]],
    read: Callable[[re.Match[bytes]], Value],
) -> list[Value] | None:
    """The parts of a document, if there is one at least and nothing else between its head and its end."""
    head, part, end = patterns
    found = head.match(body)
    if found is None:
        return None
    at, values, left = found.end(), list[Value](), _MOST_ALONE
    try:
        while left and not (values and end.match(body, at)):
            found = part.match(body, at, at + _LONGEST)
            left -= found is None
            value, at = _struct(body, at, limits) if found is None else (read(found), found.end())
            values.append(value)
    except PeerError:
        return None
    return values if left else None


def _struct(body: bytes, begin: int, limits: Limits) -> tuple[Value, int]:
    """The struct that begins here, as `reader` has it, and where it ends. Raises `PeerError` where there is none.

    What is one value in a document that has nothing else is one value in any place, a level deeper.
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
    values = Document(alone, replace(limits, depth=limits.depth - 1), "methodResponse").values
    if len(values) != 1:
        raise ProtocolError("not one struct")
    return values[0], end.end()


def _call(part: re.Match[bytes]) -> Value:
    return {"methodName": part[1].decode(), "params": _list(part[2], part[3])}


def _answer(part: re.Match[bytes]) -> Value:
    return [_list(*part.groups())]


def _fits(body: bytes, limits: Limits) -> bool:
    """Whether a document is so short that nothing in it is beyond the limits."""
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
