"""Format values as C++ prints them."""

from rosmop.runtime.action_context import Context, FaultError

MAX_PRECISION = 100
_LONG = 1024  # bytes; shorter text is not charged in advance


def to_text_integer(value: int) -> bytes:
    return b"%d" % value


def to_text_streamed(value: float) -> bytes:
    """`std::cout << value`: six significant digits."""
    return b"%g" % value


def to_text_fixed(value: float, precision: int, site: int) -> bytes:
    """`std::cout << std::fixed << std::setprecision(precision) << value`."""
    if not 0 <= precision <= MAX_PRECISION:
        raise FaultError(site, f"a precision of {precision}")
    return b"%.*f" % (precision, value)


def to_text_precise(value: float, precision: int, site: int) -> bytes:
    """`std::cout << std::setprecision(precision) << value`."""
    if not 0 <= precision <= MAX_PRECISION:
        raise FaultError(site, f"a precision of {precision}")
    return b"%.*g" % (precision, value)


def to_text_character(value: int) -> bytes:
    return bytes((value & 0xFF,))


def to_text_alternate(template: bytes, value: int) -> bytes:
    """`printf` with the flag `#`: octal begins with 0, and nonzero hexadecimal with 0x."""
    if not value:
        return template % value
    if template[-1:] != b"o":
        return (b"%#" + template[1:]) % value
    digits = len(b"%o" % value)
    _, point, precision = template[:-1].partition(b".")
    if not point:
        plain = template % value
        if len(plain) > digits and plain[:1] == b"0":
            return plain  # padded with zeros
        return (template[:-1] + b".%do" % (digits + 1)) % value
    return (template[: -1 - len(precision)] + b"%do" % max(int(precision or 0), digits + 1)) % value


def to_text_hexadecimal(value: float, plus: bool, upper: bool) -> bytes:
    """`%a`: the shortest hexadecimal form."""
    digits, exponent, power = value.hex().partition("p")
    text = (digits.rstrip("0").rstrip(".") if "." in digits else digits) + exponent + power
    if plus and value >= 0:
        text = "+" + text
    return (text.upper() if upper else text).encode()


def to_text_moment(nanoseconds: int) -> bytes:
    """`std::cout << time`: seconds, a point, nine digits."""
    sign = b"-" if nanoseconds < 0 else b""
    return b"%s%d.%09d" % (sign, *divmod(abs(nanoseconds), 1_000_000_000))


def join_all(context: Context, pieces: tuple[bytes, ...], site: int) -> bytes:
    size = sum(map(len, pieces))
    if size > _LONG:
        context.allocate(size, site)
    return b"".join(pieces)


def render(context: Context, template: bytes, arguments: tuple[object, ...], size: int, site: int) -> bytes:
    size += sum(len(argument) for argument in arguments if isinstance(argument, bytes))
    if size > _LONG:
        context.allocate(size, site)
    return template % arguments
