r"""Build XML-RPC documents in the notation of Python's `xmlrpc.client`, which every ROS client reads.

`xmlrpc_reader`, `rosmaster` and rospy read the output back as the same value. roscpp also does, except for `\r`,
because XmlRpc++ knows no character references.
"""

import binascii
import re
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from typing import Any

from roswire.errors import EncodingError
from roswire.xmlrpc.xmlrpc_values import Value

_NOT_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")
_MAX_WRITE_DEPTH = 200  # well below Python's own limit, far above the reader's limit


def build_call(method: str, params: Sequence[Value]) -> bytes:
    """Return a call. Raise `EncodingError` for a value that XML-RPC cannot represent."""
    out = ["<?xml version='1.0'?>\n<methodCall>\n<methodName>", _text(method), "</methodName>\n<params>\n"]
    for value in params:
        if type(value) is str:
            out.append(f"<param>\n<value><string>{_text(value)}</string></value>\n</param>\n")
            continue
        out.append("<param>\n")
        _write(value, out, 0)
        out.append("</param>\n")
    out.append("</params>\n</methodCall>\n")
    return "".join(out).encode()


def build_response(value: Value) -> bytes:
    """Return an answer. Raise `EncodingError` for a value that XML-RPC cannot represent."""
    out = ["<?xml version='1.0'?>\n<methodResponse>\n<params>\n<param>\n"]
    _write(value, out, 0)
    out.append("</param>\n</params>\n</methodResponse>\n")
    return "".join(out).encode()


def build_fault(code: int, text: str) -> bytes:
    """Return a fault. Characters of `text` that XML cannot represent become `?`."""
    out = ["<?xml version='1.0'?>\n<methodResponse>\n<fault>\n"]
    _write({"faultCode": code, "faultString": _NOT_XML.sub("?", text)}, out, 0)
    out.append("</fault>\n</methodResponse>\n")
    return "".join(out).encode()


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
        string = string.replace("\r", "&#13;")  # a bare carriage return is read back as a line feed
    return string


def _write(value: Value, out: list[str], depth: int) -> None:
    if depth > _MAX_WRITE_DEPTH:
        raise EncodingError(f"value nested deeper than {_MAX_WRITE_DEPTH}")
    if type(value) is str:
        out.append(f"<value><string>{_text(value)}</string></value>\n")
        return
    writer = _WRITERS.get(type(value))
    if writer is None:
        raise EncodingError(f"value of type {type(value).__name__}: XML-RPC has no notation for it")
    writer(value, out, depth)


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
        if type(item) is str:  # the most common case
            out.append(f"<value><string>{_text(item)}</string></value>\n")
        else:
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
