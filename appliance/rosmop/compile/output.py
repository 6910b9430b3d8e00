"""Output as code: `ROS_INFO("…%f…", x)`, `printf`, `std::cout << x`.

A format is read when the specification is compiled, and its conversions are checked against the arguments.
"""

import re
from collections.abc import Sequence

from appliance.rosmop.compile.conversion import convert, number
from appliance.rosmop.compile.places import Value
from appliance.rosmop.compile.scope import Scope
from appliance.rosmop.positions import Position
from appliance.rosmop.runtime import output
from appliance.rosmop.syntax import tree
from appliance.rosmop.syntax.errors import SpecificationError
from appliance.rosmop.types import kinds

FUNCTIONS = {
    "p_integer": output.to_text_integer,
    "p_floating": output.to_text_floating,
    "p_streamed": output.to_text_streamed,
    "p_fixed": output.to_text_fixed,
    "p_precise": output.to_text_precise,
    "p_character": output.to_text_character,
    "p_alternate": output.to_text_alternate,
    "p_hexadecimal": output.to_text_hexadecimal,
    "p_moment": output.to_text_moment,
    "p_join": output.join_all,
    "p_formatted": output.formatted,
}
_CONVERSION = re.compile(rb"%([-+ #0]*)(\*|[0-9]*)(?:\.(\*|[0-9]*))?(hh|h|ll|l|z|j|t|L|q)?(.?)", re.DOTALL)
_MAX_WIDTH = 1000
_LONG = 1024  # bytes that a text may have without being charged before it is made
_SIGNED, _UNSIGNED, _FLOATING = b"di", b"uoxX", b"fFeEgGaA"
_TEXTS = (kinds.String, kinds.Characters)


def formatted(scope: Scope, template: Value, arguments: Sequence[Value]) -> str:
    """Code for the bytes of a formatted text; refuses conversions that do not fit."""
    if not isinstance(template.constant, bytes):
        if arguments or not isinstance(template.type, _TEXTS):
            raise SpecificationError.at(
                template.position, 'the format must be a literal; write `"%s", …` and the text behind it'
            )
        return convert(scope, template, kinds.STRING)
    pieces, codes = [], []
    size, strings = len(template.constant), False
    last = 0
    waiting = list(arguments)
    for found in _CONVERSION.finditer(template.constant):
        pieces.append(template.constant[last : found.start()].replace(b"%", b"%%"))
        last = found.end()
        if found[0] == b"%%":
            pieces.append(b"%%")
            continue
        if not waiting:
            raise SpecificationError.at(
                template.position,
                f"`{found[0].decode('utf-8', 'replace')}` has no argument; for a percent sign write `%%`",
            )
        value = waiting.pop(0)
        piece, code = _conversion(scope, found, value, template.position)
        pieces.append(piece)
        codes.append(code)
        known = isinstance(value.constant, bytes)
        size += _longest(found) + (len(code) if known else 0)
        strings = strings or (piece[-1:] == b"s" and not known)
    if waiting:
        raise SpecificationError.at(
            waiting[0].position, "this argument has no conversion in the format, such as `%f` or `%s`"
        )
    text = b"".join(pieces) + template.constant[last:].replace(b"%", b"%%")
    if not codes:
        return repr(text.replace(b"%%", b"%"))
    if strings or size > _LONG:
        return f"p_formatted({scope.context}, {text!r}, ({', '.join(codes)},), {size}, {scope.lines.site})"
    return f"({text!r} % ({', '.join(codes)},))"


def _longest(found: re.Match[bytes]) -> int:
    """How long the text of a conversion can be, but for strings."""
    return max(int(found[2] or 0), int(found[3] or 0) + (400 if found[5] in _FLOATING else 20))


def _conversion(scope: Scope, found: re.Match[bytes], value: Value, where: Position) -> tuple[bytes, str]:
    flags, width, precision, size, letter = found.groups()
    shown = found[0].decode("utf-8", "replace")
    if b"*" in (width, precision) or max(int(width or 0), int(precision or 0)) > _MAX_WIDTH:
        raise SpecificationError.at(where, f"the width in `{shown}` must be a number up to {_MAX_WIDTH}")
    head = b"%" + flags + width + (b"" if precision is None else b"." + precision)
    if not letter:
        raise SpecificationError.at(where, f"`{shown}` is no conversion; for a percent sign write `%%`")
    if letter == b"s":
        if not isinstance(value.type, _TEXTS):
            raise SpecificationError.at(value.position, f"`{shown}` needs a string; this is {value.type}")
        return head + b"s", convert(scope, value, kinds.STRING)
    if letter == b"c":
        if not isinstance(value.type, kinds.Integer | kinds.Bool):
            raise SpecificationError.at(value.position, f"`{shown}` needs a char; this is {value.type}")
        return head + b"s", f"p_character({value.code})"
    if letter not in _SIGNED + _UNSIGNED + _FLOATING:
        raise SpecificationError.at(where, f"`{shown}` is no conversion; write %d, %u, %f, %g, %s or %c")
    if not kinds.is_number(value.type):
        hint = "; write %s" if isinstance(value.type, _TEXTS) else "; write `.toSec()`"
        raise SpecificationError.at(value.position, f"`{shown}` needs a number; this is {value.type}{hint}")
    if letter in b"aA":
        if precision is not None:
            raise SpecificationError.at(where, f"`{shown}`: write `%a` without a precision")
        code = number(value.code, value.type, kinds.DOUBLE)
        left = b"-" if b"-" in flags else b""
        return b"%" + left + width + b"s", f"p_hexadecimal({code}, {b'+' in flags}, {letter == b'A'})"
    if letter in _FLOATING:
        return head + letter, number(value.code, value.type, kinds.DOUBLE)
    code = _integer(letter, size, value)
    return _integer_head(flags, width, precision, letter, code)


def _integer(letter: bytes, size: bytes | None, value: Value) -> str:
    """Code for what an integer conversion prints: as wide as its letters say, signed or unsigned as they say.

    Without a size it is as wide as the value; a floating-point value is truncated.
    """
    kind = kinds.promoted(value.type)
    bits = kind.bits if isinstance(kind, kinds.Integer) else 64
    bits = {b"hh": 8, b"h": 16, None: bits}.get(size, 64)
    target = kinds.Integer(bits, letter in _SIGNED, "")
    if isinstance(kind, kinds.Integer):
        return number(value.code, value.type, target)
    return number(number(value.code, value.type, kinds.LONG), kinds.LONG, target)


def _integer_head(
    flags: bytes, width: bytes, precision: bytes | None, letter: bytes, code: str
) -> tuple[bytes, str]:
    """What Python writes for an integer conversion, and the argument; where the two differ, C's answer."""
    if letter in _UNSIGNED:
        flags = flags.replace(b"+", b"").replace(b" ", b"")
    if precision is not None:
        flags = flags.replace(b"0", b"")
    point = b"" if precision is None else b"." + precision
    python = letter.replace(b"u", b"d")
    if b"#" in flags and letter in b"oxX":
        template = b"%" + flags.replace(b"#", b"") + width + point + python
        return b"%s", f"p_alternate({template!r}, {code})"
    return b"%" + flags.replace(b"#", b"") + width + point + python, code


class Stream:
    """The state of `<<` in one statement: what `std::fixed` and `std::setprecision` said before."""

    def __init__(self, scope: Scope, site: int) -> None:
        self._scope = scope
        self._site = site
        self._fixed = False
        self._precision: str | None = None

    def manipulated(self, node: tree.Expression, value: Value | None) -> bool:
        """Take a manipulator; False if this is none. `value` is the argument of `setprecision`."""
        parts = node.parts if isinstance(node, tree.Name) else ()
        name = parts[-1] if parts and parts[:-1] in ((), ("std",)) else ""
        if name in ("fixed", "defaultfloat", "scientific"):
            if name == "scientific":
                raise SpecificationError.at(
                    node.position, "`std::scientific` is not known; write `std::fixed`"
                )
            self._fixed = name == "fixed"
            return True
        if value is not None:
            self._precision = number(value.code, value.type, kinds.INT)
            return True
        return name == "flush"

    def piece(self, value: Value) -> str:
        """Code for the bytes of one value."""
        kind = value.type
        if isinstance(kind, _TEXTS):
            return convert(self._scope, value, kinds.STRING)
        if isinstance(kind, kinds.Floating):
            return self._floating(value)
        if not isinstance(kind, kinds.Bool | kinds.Integer | kinds.Time | kinds.Duration):
            hint = "; write an index or a field" if isinstance(kind, kinds.Vector | kinds.Record) else ""
            raise SpecificationError.at(value.position, f"{kind} cannot be printed{hint}")
        if isinstance(kind, kinds.Time | kinds.Duration):
            return f"p_moment({value.code})"
        is_character = isinstance(kind, kinds.Integer) and kind.bits == 8
        return f"p_{'character' if is_character else 'integer'}({value.code})"

    def _floating(self, value: Value) -> str:
        if self._fixed:
            return f"p_fixed({value.code}, {self._precision or 6}, {self._site})"
        if self._precision is not None:
            return f"p_precise({value.code}, {self._precision}, {self._site})"
        return f"p_streamed({value.code})"
