"""Reading the documents that a ROS network is full of: names, numbers and lists of names, as its clients write them.

One pattern has the whole document, where `reader` walks through its elements. It takes nothing that `reader` would not
take, and as the same values; what it does not know, whatever may be in it, is left to `reader`, which also has all
errors. Texts are printable ASCII without a character that means something in XML.
"""

import re

from appliance.ros.xmlrpc.values import Limits, Value

_LONGEST = 32 << 10  # bytes of a document
# Of two stars that can take the same byte one gives nothing back (`*+`): time is linear in the document.
_SPACE = rb"[ \t\r\n]*+"
_TEXT = rb"[ -%'-;=?-~]*+"
_INTEGER = rb"-?[0-9]{1,9}"


def _scalar(text: bytes, integer: bytes) -> bytes:
    kinds = b"<string>" + text + b"</string>", b"<int>" + integer + b"</int>", b"<i4>" + integer + b"</i4>"
    return b"<value>(?:" + b"|".join([*kinds, text]) + b")</value>"


_ONE = _scalar(_TEXT, _INTEGER)
_EACH = b"(?:" + _ONE + _SPACE + b")*"
_ARRAY, _END = b"<value><array><data>" + _SPACE, b"</data></array></value>" + _SPACE
_DECLARED = rb"<\?xml version=(?:'1\.0'|\"1\.0\")\?>" + _SPACE


def _document(*parts: bytes) -> re.Pattern[bytes]:
    return re.compile(_DECLARED + _SPACE.join(parts) + _SPACE + rb"\Z")


_CALL = _document(
    b"<methodCall>", rb"<methodName>([A-Za-z.]+)</methodName>", b"<params>",
    b"((?:<param>" + _SPACE + _ONE + _SPACE + b"</param>" + _SPACE + b")*)</params>", b"</methodCall>",
)  # fmt: skip


def _list_in(group: bytes) -> bytes:
    """A list of scalars whose last may be such a list; what begins a group of each."""
    each = group + _EACH + b")"
    return _ARRAY + each + b"(?:" + _ARRAY + each + _END + b")?" + _END


def _answer(value: bytes) -> re.Pattern[bytes]:
    return _document(
        b"<methodResponse>", b"<params>", b"<param>", value, b"</param>", b"</params>", b"</methodResponse>"
    )


_ANSWER = _answer(_list_in(b"("))
_PART = re.compile(_ARRAY + _list_in(b"(") + _END)  # of the answer to a multicall
_ANSWERS = _answer(_ARRAY + b"((?:" + _ARRAY + _list_in(b"(?:") + _END + b")+)" + _END)
_VALUE = re.compile(_scalar(b"(" + _TEXT + b")", b"(" + _INTEGER + b")"))


def usual_call(body: bytes, limits: Limits) -> tuple[str, list[Value]] | None:
    """The method and the parameters of a call, if they are names and numbers; else None."""
    found = _CALL.match(body) if _fits(body, limits) else None
    return None if found is None else (found[1].decode(), _values(found[2]))


def usual_answer(body: bytes, limits: Limits) -> list[Value] | None:
    """The answer, if it is a list of names and numbers whose last may be such a list, or several of a multicall's."""
    if not _fits(body, limits):
        return None
    found = _ANSWER.match(body)
    if found is not None:
        return _list(found)
    several = _ANSWERS.match(body)
    return None if several is None else [[_list(part)] for part in _PART.finditer(several[1])]


def _fits(body: bytes, limits: Limits) -> bool:
    """Whether a document is so short that nothing in it is beyond the limits."""
    return len(body) <= min(_LONGEST, limits.body, limits.string, limits.elements) and limits.depth > 3


def _list(found: re.Match[bytes]) -> list[Value]:
    return _values(found[1]) if found[2] is None else [*_values(found[1]), _values(found[2])]


def _values(text: bytes) -> list[Value]:
    return [
        int(whole or four) if whole or four else (string or untyped).decode()
        for string, whole, four, untyped in _VALUE.findall(text)
    ]
