"""The values of XML-RPC, and the limits for one document."""

from dataclasses import dataclass
from datetime import datetime
from typing import TypeAlias

Value: TypeAlias = "bool | int | float | str | bytes | datetime | list[Value] | dict[str, Value] | None"


@dataclass(frozen=True, slots=True)
class XmlRpcLimits:
    """The limits of one document. The defaults exceed the documents of a large robot."""

    body: int = 16 << 20  # bytes
    elements: int = 1_000_000  # values, including those in arrays and structs
    depth: int = 100  # nested arrays and structs
    string: int = 8 << 20  # characters of one string, or of the text of one base64 value
    parts: int = 100_000  # calls in one system.multicall


DEFAULT_LIMITS = XmlRpcLimits()
