"""Values that are set after the parts of control that need them are made."""

from typing import Generic, TypeVar

T = TypeVar("T")


class Current(Generic[T]):
    """A value that is set after its readers are made. An earlier call raises `RuntimeError`."""

    def __init__(self) -> None:
        self._values: list[T] = []

    def set(self, value: T) -> None:
        self._values = [value]

    def __bool__(self) -> bool:
        return bool(self._values)

    def __call__(self) -> T:
        if not self._values:
            raise RuntimeError("this part of control is used before it is created")
        return self._values[0]
