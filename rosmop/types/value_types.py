"""The types of values: C++'s arithmetic types, strings, times, vectors and messages.

A type prints as in C++. Values are `bool`, `int` and `float`; bytes for strings and buffers; integer
nanoseconds for times and durations; lists for vectors and for the fields of messages.
"""

import msgspec


def _tag(name: str) -> str:
    return name.removesuffix("Type")


class _Kind(msgspec.Struct, frozen=True, tag=_tag, tag_field="kind", array_like=True):
    """A type; its tag is the class name without `Type`."""


class VoidType(_Kind, frozen=True):
    """The type without values, `void`."""

    def __str__(self) -> str:
        return "void"


class IteratorType(_Kind, frozen=True):
    """A position in a vector; variables cannot hold it."""

    def __str__(self) -> str:
        return "an iterator"


class BoolType(_Kind, frozen=True):
    """`bool`."""

    def __str__(self) -> str:
        return "bool"


class IntegerType(_Kind, frozen=True):
    """An integer type. Its `name` serves only error messages, because `long` and `long long` are the same type."""

    bits: int
    signed: bool
    name: str

    @property
    def least(self) -> int:
        return -(1 << (self.bits - 1)) if self.signed else 0

    @property
    def most(self) -> int:
        return (1 << (self.bits - self.signed)) - 1

    def holds(self, other: "IntegerType") -> bool:
        return self.least <= other.least and other.most <= self.most

    def __eq__(self, other: object) -> bool:
        return isinstance(other, IntegerType) and (self.bits, self.signed) == (other.bits, other.signed)

    def __hash__(self) -> int:
        return hash((self.bits, self.signed))

    def __str__(self) -> str:
        return self.name


class FloatingType(_Kind, frozen=True):
    """`float` or `double`."""

    bits: int

    def __str__(self) -> str:
        return "float" if self.bits == 32 else "double"


class StringType(_Kind, frozen=True):
    """`std::string`."""

    def __str__(self) -> str:
        return "std::string"


class CharactersType(_Kind, frozen=True):
    """`char *` and `char name[n]`: a buffer of characters."""

    def __str__(self) -> str:
        return "char *"


class TimeType(_Kind, frozen=True):
    """`ros::Time`."""

    def __str__(self) -> str:
        return "ros::Time"


class DurationType(_Kind, frozen=True):
    """`ros::Duration`."""

    def __str__(self) -> str:
        return "ros::Duration"


class VectorType(_Kind, frozen=True):
    """`std::vector<element>`, or an array if it has a `length`."""

    element: "Type"
    length: int | None = None

    def __str__(self) -> str:
        return f"std::vector<{self.element}>" if self.length is None else f"{self.element}[{self.length}]"


class RecordType(_Kind, frozen=True):
    """A message type, `package/Type`."""

    name: str

    def __str__(self) -> str:
        return self.name.replace("/", "::")


Value = float | bytes | list["Value"]
"""A value at run time, of any of these types; `bool` and `int` are `float` to a type checker."""

Type = (
    VoidType
    | IteratorType
    | BoolType
    | IntegerType
    | FloatingType
    | StringType
    | CharactersType
    | TimeType
    | DurationType
    | VectorType
    | RecordType
)

VOID, BOOL, STRING, CHARACTERS, TIME, DURATION, INDEX = (
    VoidType(), BoolType(), StringType(), CharactersType(), TimeType(), DurationType(), IteratorType()
)  # fmt: skip
CHAR = IntegerType(8, True, "char")
INT8 = IntegerType(8, True, "int8_t")
UINT8 = IntegerType(8, False, "uint8_t")
INT16 = IntegerType(16, True, "int16_t")
UINT16 = IntegerType(16, False, "uint16_t")
INT = IntegerType(32, True, "int")
UINT = IntegerType(32, False, "unsigned int")
LONG = IntegerType(64, True, "long")
ULONG = IntegerType(64, False, "unsigned long")
FLOAT, DOUBLE = FloatingType(32), FloatingType(64)

NUMBERS = (BoolType, IntegerType, FloatingType)


def is_number(kind: Type) -> bool:
    return isinstance(kind, NUMBERS)


def is_scalar(kind: Type) -> bool:
    """Whether values of this type never change in place, so that they need no copy."""
    return not isinstance(kind, VectorType | RecordType)


def promote(kind: Type) -> Type:
    if isinstance(kind, BoolType) or (isinstance(kind, IntegerType) and kind.bits < 32):
        return INT
    return kind


def common(left: Type, right: Type) -> Type:
    left, right = promote(left), promote(right)
    if isinstance(left, FloatingType) or isinstance(right, FloatingType):
        wide = [kind.bits for kind in (left, right) if isinstance(kind, FloatingType)]
        return FloatingType(max(wide))
    assert isinstance(left, IntegerType)  # noqa: S101  for mypy: the remaining numbers are integers
    assert isinstance(right, IntegerType)  # noqa: S101  as above
    if left.signed == right.signed:
        return left if left.bits >= right.bits else right
    signed, unsigned = (left, right) if left.signed else (right, left)
    return signed if signed.bits > unsigned.bits else unsigned


def convertible(source: Type, target: Type) -> bool:
    if is_number(source) and is_number(target):
        return True
    if isinstance(target, StringType | CharactersType):
        return isinstance(source, StringType | CharactersType)
    if isinstance(source, VectorType) and isinstance(target, VectorType):
        lengths = (source.length, target.length)
        return same_elements(source.element, target.element) and (None in lengths or lengths[0] == lengths[1])
    return source == target


def same_elements(one: Type, other: Type) -> bool:
    """Whether ROS encodes vectors of both element types alike: bytes, characters and booleans each take one byte."""
    bytes_alike = all(isinstance(kind, BoolType) or (isinstance(kind, IntegerType) and kind.bits == 8)
                      for kind in (one, other))  # fmt: skip
    if bytes_alike:
        return True
    if isinstance(one, VectorType) and isinstance(other, VectorType):
        return same_elements(one.element, other.element)
    return one == other
