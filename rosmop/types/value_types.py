"""The types of values: C++'s arithmetic types, strings, times, vectors and messages.

A type is a value object; its text is how C++ writes it. How values are held while actions run: `bool`, `int` and
`float` as Python's; strings and `char *` buffers as bytes; times and durations as integer nanoseconds; vectors
and messages as lists (a message's fields in the order of its definition).
"""

import msgspec


class _Kind(msgspec.Struct, frozen=True, tag=True, tag_field="kind", array_like=True):
    """What all types are."""


class Void(_Kind, frozen=True):
    """No value."""

    def __str__(self) -> str:
        return "void"


class Index(_Kind, frozen=True):
    """A place in a vector, which no variable holds."""

    def __str__(self) -> str:
        return "an iterator"


class Bool(_Kind, frozen=True):
    """`bool`."""

    def __str__(self) -> str:
        return "bool"


class Integer(_Kind, frozen=True):
    """An integer type; `name` is only for messages (`long` and `long long` are the same type)."""

    bits: int
    signed: bool
    name: str

    @property
    def least(self) -> int:
        """The smallest value."""
        return -(1 << (self.bits - 1)) if self.signed else 0

    @property
    def most(self) -> int:
        """The largest value."""
        return (1 << (self.bits - self.signed)) - 1

    def holds(self, other: "Integer") -> bool:
        """Whether every value of the other type is a value of this one."""
        return self.least <= other.least and other.most <= self.most

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Integer) and (self.bits, self.signed) == (other.bits, other.signed)

    def __hash__(self) -> int:
        return hash((self.bits, self.signed))

    def __str__(self) -> str:
        return self.name


class Floating(_Kind, frozen=True):
    """`float` or `double`."""

    bits: int

    def __str__(self) -> str:
        return "float" if self.bits == 32 else "double"


class String(_Kind, frozen=True):
    """`std::string`."""

    def __str__(self) -> str:
        return "std::string"


class Characters(_Kind, frozen=True):
    """`char *` and `char name[n]`: a buffer of characters."""

    def __str__(self) -> str:
        return "char *"


class Time(_Kind, frozen=True):
    """`ros::Time`."""

    def __str__(self) -> str:
        return "ros::Time"


class Duration(_Kind, frozen=True):
    """`ros::Duration`."""

    def __str__(self) -> str:
        return "ros::Duration"


class Vector(_Kind, frozen=True):
    """`std::vector<element>`, or with a `length` an array of exactly so many."""

    element: "Type"
    length: int | None = None

    def __str__(self) -> str:
        return f"std::vector<{self.element}>" if self.length is None else f"{self.element}[{self.length}]"


class Record(_Kind, frozen=True):
    """A message type, `package/Type`."""

    name: str

    def __str__(self) -> str:
        return self.name.replace("/", "::")


Type = Void | Index | Bool | Integer | Floating | String | Characters | Time | Duration | Vector | Record
"""Any type."""

VOID, BOOL, STRING, CHARACTERS, TIME, DURATION, INDEX = (
    Void(), Bool(), String(), Characters(), Time(), Duration(), Index()
)  # fmt: skip
CHAR = Integer(8, True, "char")
INT8 = Integer(8, True, "int8_t")
UINT8 = Integer(8, False, "uint8_t")
INT16 = Integer(16, True, "int16_t")
UINT16 = Integer(16, False, "uint16_t")
INT = Integer(32, True, "int")
UINT = Integer(32, False, "unsigned int")
LONG = Integer(64, True, "long")
ULONG = Integer(64, False, "unsigned long")
FLOAT, DOUBLE = Floating(32), Floating(64)

Number = Bool | Integer | Floating
NUMBERS = (Bool, Integer, Floating)


def is_number(kind: Type) -> bool:
    """Whether C++ calculates with values of this type."""
    return isinstance(kind, NUMBERS)


def is_scalar(kind: Type) -> bool:
    """Whether values of this type never change in place, so that a copy is not needed."""
    return not isinstance(kind, Vector | Record)


def promoted(kind: Type) -> Type:
    """The type C++ calculates in for an operand of this type."""
    if isinstance(kind, Bool) or (isinstance(kind, Integer) and kind.bits < 32):
        return INT
    return kind


def common(left: Type, right: Type) -> Type:
    """The type C++ calculates in for two numbers."""
    left, right = promoted(left), promoted(right)
    if isinstance(left, Floating) or isinstance(right, Floating):
        wide = [kind.bits for kind in (left, right) if isinstance(kind, Floating)]
        return Floating(max(wide))
    assert isinstance(left, Integer)  # noqa: S101  for mypy: numbers that are not floating are integers by now
    assert isinstance(right, Integer)  # noqa: S101  as the left one
    if left.signed == right.signed:
        return left if left.bits >= right.bits else right
    signed, unsigned = (left, right) if left.signed else (right, left)
    return signed if signed.bits > unsigned.bits else unsigned


def convertible(source: Type, target: Type) -> bool:
    """Whether a value of one type can be assigned to a variable of another."""
    if is_number(source) and is_number(target):
        return True
    if isinstance(target, String | Characters):
        return isinstance(source, String | Characters)
    if isinstance(source, Vector) and isinstance(target, Vector):
        lengths = (source.length, target.length)
        return same_elements(source.element, target.element) and (None in lengths or lengths[0] == lengths[1])
    return source == target


def same_elements(one: Type, other: Type) -> bool:
    """Whether vectors of these elements are the same to ROS: bytes, characters and booleans are all bytes."""
    bytes_alike = all(isinstance(kind, Bool) or (isinstance(kind, Integer) and kind.bits == 8)
                      for kind in (one, other))  # fmt: skip
    if bytes_alike:
        return True
    if isinstance(one, Vector) and isinstance(other, Vector):
        return same_elements(one.element, other.element)
    return one == other
