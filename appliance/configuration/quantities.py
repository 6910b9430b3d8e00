"""Define the types of settings with a unit, and the rules for values.

pydantic reads the metadata of these types; msgspec and the users of a setting see only the plain type. The metadata
imports pydantic when pydantic reads it, because each process and each verb loads the settings of all features.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Annotated, ClassVar


@dataclass(frozen=True)
class Metadata:
    """Metadata that pydantic takes as several, and makes with its own module when it reads them."""

    make: Callable[[ModuleType], Iterable[object]]
    __is_annotated_types_grouped_metadata__: ClassVar[bool] = True

    def __iter__(self) -> Iterator[object]:
        import pydantic  # noqa: PLC0415  see the head

        return iter(self.make(pydantic))


def rules(**given: object) -> Metadata:
    """Return the rules of pydantic's `Field`, such as `gt=0`."""
    return Metadata(lambda pydantic: pydantic.Field(**given).metadata)


def check(function: Callable[[object], object]) -> Metadata:
    """Return a check that a value has to pass; the function raises `ValueError`."""
    return Metadata(lambda pydantic: (pydantic.AfterValidator(function),))


BYTES = Metadata(
    lambda pydantic: (pydantic.GetPydanticSchema(lambda _source, handler: handler(pydantic.ByteSize)),)
)
Seconds = Annotated[float, rules(gt=0, le=86_400 * 365, allow_inf_nan=False)]
Milliseconds = Annotated[float, rules(ge=1.0, le=1000.0, allow_inf_nan=False)]
Count = Annotated[int, rules(gt=0)]
Size = Annotated[int, BYTES, rules(gt=0)]
SizeOfMebibytes = Annotated[int, BYTES, rules(ge=1 << 20)]  # at least 1 MiB
WithinAnHour = Annotated[float, rules(gt=0, le=3600, allow_inf_nan=False)]
