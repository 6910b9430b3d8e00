"""Compile output: `ROS_INFO("…%f…", x)`, `printf`, `std::cout << x`. Formats are checked against their arguments."""

import re
from collections.abc import Sequence

from rosmop.check.assignables import Value
from rosmop.check.conversion import convert, number
from rosmop.check.scope import FunctionScope
from rosmop.form import nodes
from rosmop.form.findings import Position, SpecificationError
from rosmop.text import tree
from rosmop.types import value_types

_CONVERSION = re.compile(rb"%([-+ #0]*+)(\*|[0-9]*+)(?:\.(\*|[0-9]*+))?(hh|h|ll|l|z|j|t|L|q)?(.?)", re.DOTALL)
_MAX_WIDTH = 1000
_LONG = 1024  # bytes; shorter text without strings is not charged in advance
_SIGNED, _UNSIGNED, _FLOATING = b"di", b"uoxX", b"fFeEgGaA"
_TEXTS = (value_types.StringType, value_types.CharactersType)


def compile_format(scope: FunctionScope, template: Value, arguments: Sequence[Value]) -> nodes.Expression:
    if not isinstance(template.constant, bytes):
        if arguments or not isinstance(template.type, _TEXTS):
            raise SpecificationError.at(
                template.position, 'the format must be a literal; write `"%s", …` and the string after it'
            )
        return convert(scope, template, value_types.STRING)
    pieces: list[bytes] = []
    values: list[nodes.Expression] = []
    size, strings = len(template.constant), False
    last = 0
    waiting = list(arguments)
    for written in _CONVERSION.finditer(template.constant):
        pieces.append(template.constant[last : written.start()].replace(b"%", b"%%"))
        last = written.end()
        match = _with_widths(written, waiting)
        if match[0] == b"%%":
            pieces.append(b"%%")
            continue
        if not waiting:
            raise SpecificationError.at(
                template.position,
                f"`{written[0].decode('utf-8', 'replace')}` has no argument; for a percent sign write `%%`",
            )
        value = waiting.pop(0)
        piece, converted = _conversion(scope, match, value, template.position)
        pieces.append(piece)
        values.append(converted)
        known = isinstance(value.constant, bytes)
        size += _longest(match) + (len(value.constant) if isinstance(value.constant, bytes) else 0)
        strings = strings or (piece[-1:] == b"s" and not known)
    if waiting:
        raise SpecificationError.at(
            waiting[0].position, "this argument has no conversion in the format, such as `%f` or `%s`"
        )
    text = b"".join(pieces) + template.constant[last:].replace(b"%", b"%%")
    if not values:
        return nodes.Literal(value_types.STRING, text.replace(b"%%", b"%"))
    charged = size if strings or size > _LONG else None
    return nodes.Format(text, tuple(values), charged, scope.lines.site)


def _with_widths(match: re.Match[bytes], waiting: list[Value]) -> re.Match[bytes]:
    flags, width, precision, size, letter = (part or b"" for part in match.groups())
    if width == b"*" and (number := _literal_width(waiting)) is not None:
        flags, width = (flags, b"%d" % number) if number >= 0 else (flags + b"-", b"%d" % -number)
    point = b"" if match[3] is None else b"." + precision
    if precision == b"*" and (number := _literal_width(waiting)) is not None:
        point = b".%d" % number if number >= 0 else b""
    made = _CONVERSION.fullmatch(b"%" + flags + width + point + size + letter)
    return made if made is not None else match


def _literal_width(waiting: list[Value]) -> int | None:
    if not waiting or type(waiting[0].constant) is not int:
        return None
    return waiting.pop(0).constant  # type: ignore[return-value] # checked above


def _longest(match: re.Match[bytes]) -> int:
    return max(int(match[2] or 0), int(match[3] or 0) + (400 if match[5] in _FLOATING else 20))


def _conversion(
    scope: FunctionScope, match: re.Match[bytes], value: Value, where: Position
) -> tuple[bytes, nodes.Expression]:
    flags, width, precision, size, letter = match.groups()
    shown = match[0].decode("utf-8", "replace")
    if b"*" in (width, precision) or max(int(width or 0), int(precision or 0)) > _MAX_WIDTH:
        raise SpecificationError.at(where, f"the width in `{shown}` must be a number up to {_MAX_WIDTH}")
    head = b"%" + flags + width + (b"" if precision is None else b"." + precision)
    if not letter:
        raise SpecificationError.at(where, f"`{shown}` is not a conversion; for a percent sign write `%%`")
    if letter == b"s":
        if not isinstance(value.type, _TEXTS):
            raise SpecificationError.at(value.position, f"`{shown}` needs a string; this is {value.type}")
        return head + b"s", convert(scope, value, value_types.STRING)
    if letter == b"c":
        if not isinstance(value.type, value_types.IntegerType | value_types.BoolType):
            raise SpecificationError.at(value.position, f"`{shown}` needs a char; this is {value.type}")
        return head + b"s", nodes.Call(value_types.STRING, "p_character", (value.form,))
    if letter not in _SIGNED + _UNSIGNED + _FLOATING:
        raise SpecificationError.at(where, f"`{shown}` is not a conversion; write %d, %u, %f, %g, %s or %c")
    if not value_types.is_number(value.type):
        hint = "; write %s" if isinstance(value.type, _TEXTS) else "; write `.toSec()`"
        raise SpecificationError.at(value.position, f"`{shown}` needs a number; this is {value.type}{hint}")
    if letter in b"aA":
        if precision is not None:
            raise SpecificationError.at(where, f"`{shown}`: write `%a` without a precision")
        signed = (
            nodes.Literal(value_types.BOOL, b"+" in flags),
            nodes.Literal(value_types.BOOL, letter == b"A"),
        )
        digits = nodes.Call(
            value_types.STRING, "p_hexadecimal", (number(value.form, value_types.DOUBLE), *signed)
        )
        return b"%" + (b"-" if b"-" in flags else b"") + width + b"s", digits
    if letter in _FLOATING:
        return head + letter, number(value.form, value_types.DOUBLE)
    return _integer_head(flags, width, precision, letter, _integer(letter, size, value))


def _integer(letter: bytes, size: bytes | None, value: Value) -> nodes.Expression:
    kind = value_types.promote(value.type)
    bits = kind.bits if isinstance(kind, value_types.IntegerType) else 64
    bits = {b"hh": 8, b"h": 16, None: bits}.get(size, 64)
    target = value_types.IntegerType(bits, letter in _SIGNED, "")
    if isinstance(kind, value_types.IntegerType):
        return number(value.form, target)
    return number(number(value.form, value_types.LONG), target)


def _integer_head(
    flags: bytes, width: bytes, precision: bytes | None, letter: bytes, value: nodes.Expression
) -> tuple[bytes, nodes.Expression]:
    if letter in _UNSIGNED:
        flags = flags.replace(b"+", b"").replace(b" ", b"")
    if precision is not None:
        flags = flags.replace(b"0", b"")
    point = b"" if precision is None else b"." + precision
    python = letter.replace(b"u", b"d")
    if b"#" in flags and letter in b"oxX":
        template = b"%" + flags.replace(b"#", b"") + width + point + python
        return b"%s", nodes.Call(
            value_types.STRING, "p_alternate", (nodes.Literal(value_types.STRING, template), value)
        )
    return b"%" + flags.replace(b"#", b"") + width + point + python, value


class OutputStream:
    """The manipulators of one statement with `<<`: `std::fixed` and `std::setprecision`."""

    def __init__(self, scope: FunctionScope, site: int) -> None:
        self._scope = scope
        self._site = site
        self._fixed = False
        self._precision: nodes.Expression | None = None

    def apply_manipulator(self, node: tree.Expression, value: Value | None) -> bool:
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
            self._precision = number(value.form, value_types.INT)
            return True
        return name == "flush"

    def piece(self, value: Value) -> nodes.Expression:
        kind = value.type
        if isinstance(kind, _TEXTS):
            return convert(self._scope, value, value_types.STRING)
        if isinstance(kind, value_types.FloatingType):
            return self._floating(value)
        if not isinstance(
            kind,
            value_types.BoolType | value_types.IntegerType | value_types.TimeType | value_types.DurationType,
        ):
            hint = (
                "; write an index or a field"
                if isinstance(kind, value_types.VectorType | value_types.RecordType)
                else ""
            )
            raise SpecificationError.at(value.position, f"{kind} cannot be printed{hint}")
        if isinstance(kind, value_types.TimeType | value_types.DurationType):
            return nodes.Call(value_types.STRING, "p_moment", (value.form,))
        is_character = isinstance(kind, value_types.IntegerType) and kind.bits == 8
        return nodes.Call(value_types.STRING, "p_character" if is_character else "p_integer", (value.form,))

    def _floating(self, value: Value) -> nodes.Expression:
        precision = self._precision
        if precision is None and not self._fixed:
            return nodes.Call(value_types.STRING, "p_streamed", (value.form,))
        digits = nodes.Literal(value_types.INT, 6) if precision is None else precision
        function = "p_fixed" if self._fixed else "p_precise"
        return nodes.Call(value_types.STRING, function, (value.form, digits), self._site)
