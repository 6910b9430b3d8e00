"""Values as text, as C++ prints them."""

from appliance.rosmop.runtime.context import FaultError

_MAX_PRECISION = 100


def to_text_integer(value: int) -> bytes:
    """`std::to_string` of an integer, and `<<` of one."""
    return b"%d" % value


def to_text_floating(value: float) -> bytes:
    """`std::to_string` of a floating-point number: six digits behind the point."""
    return b"%f" % value


def to_text_streamed(value: float) -> bytes:
    """`std::cout << value`: six digits in all."""
    return b"%g" % value


def to_text_fixed(value: float, precision: int, site: int) -> bytes:
    """`std::cout << std::fixed << std::setprecision(precision) << value`."""
    if not 0 <= precision <= _MAX_PRECISION:
        raise FaultError(site, f"a precision of {precision}")
    return b"%.*f" % (precision, value)


def to_text_precise(value: float, precision: int, site: int) -> bytes:
    """`std::cout << std::setprecision(precision) << value`."""
    if not 0 <= precision <= _MAX_PRECISION:
        raise FaultError(site, f"a precision of {precision}")
    return b"%.*g" % (precision, value)


def to_text_character(value: int) -> bytes:
    """`std::cout << character`."""
    return bytes((value & 0xFF,))


def to_text_moment(nanoseconds: int) -> bytes:
    """`std::cout << time`: seconds, a point, nine digits."""
    sign = b"-" if nanoseconds < 0 else b""
    return b"%s%d.%09d" % (sign, *divmod(abs(nanoseconds), 1_000_000_000))


def join_all(pieces: tuple[bytes, ...]) -> bytes:
    """The pieces in a row."""
    return b"".join(pieces)
