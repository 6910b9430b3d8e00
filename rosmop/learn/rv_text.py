"""Write numbers, strings, names and conditions of `.rv` text."""

import math
import re
from collections.abc import Iterable
from decimal import ROUND_CEILING, Decimal

from rosmop.text.complaints import FORBIDDEN, RESERVED

_ESCAPES = {"\\": "\\\\", '"': '\\"', "\n": "\\n", "\t": "\\t", "\r": "\\r"}
_PRINTABLE = re.compile(r"[ -~]*+\Z")
CPP = {
    "float32": "float", "float64": "double", "byte": "int8_t", "char": "uint8_t", "string": "std::string",
    "bool": "bool", **{f"{sign}int{size}": f"{sign}int{size}_t" for sign in ("", "u") for size in (8, 16, 32, 64)},
}  # fmt: skip
WORDS = frozenset(FORBIDDEN) | RESERVED


def rounded_up(value: float, width: float) -> str:
    if not width > 0:
        return number(value)
    quantum = Decimal(1).scaleb(math.floor(math.log10(width / 100)))
    return number(float(Decimal(value).quantize(quantum, ROUND_CEILING)))


def rounded_down(value: float, width: float) -> str:
    return number(-float(rounded_up(-value, width)))


def number(value: float) -> str:
    text = repr(value)
    if isinstance(value, int) and value >= 1 << 63:
        return f"{text}u"  # only an unsigned type holds it
    return "0.0" if text == "-0.0" else text


def literal(value: object) -> str | None:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'"{quoted(value)}"' if _PRINTABLE.match(value) else None
    return number(value) if isinstance(value, int | float) and math.isfinite(value) else None


def quoted(text: str) -> str:
    return "".join(_ESCAPES.get(letter, letter) for letter in text)


def one_line(text: str) -> str:
    """Replace line ends by spaces, and escape other control characters."""
    words = " ".join(text.split())
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in words)


def formatted(text: str) -> str:
    return quoted(text).replace("%", "%%")


def identifier(text: str) -> str:
    name = re.sub(r"[^A-Za-z0-9]++", "_", text).strip("_") or "root"
    return f"n{name}" if name[0].isdigit() else name


def short_names(paths: Iterable[str]) -> dict[str, str]:
    paths = list(paths)
    names: dict[str, str] = {}
    for path in paths:
        steps = path.split(".")
        for count in range(1, len(steps) + 1):
            end = ".".join(steps[-count:])
            others = (other for other in paths if other != path)
            if count == len(steps) or not any(other == end or other.endswith("." + end) for other in others):
                name = "_".join(steps[-count:])
                taken = name in WORDS or name in names.values() or name in _OWN
                names[path] = f"{name}_field" if taken else name
                break
    return names


_OWN = frozenset(
    {"now", "elapsed", "before", "begun", "i", "messages", "opened", "message", "stamped", "abs", "isinf"}
)
