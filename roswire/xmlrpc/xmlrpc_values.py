"""What XML-RPC can carry, and how much of it is taken from a peer in one document."""

from dataclasses import dataclass
from datetime import datetime
from typing import TypeAlias

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
