"""Values and functions that are set after the parts of control that need them are made."""

from collections.abc import Callable
from typing import Generic, ParamSpec, TypeVar

P = ParamSpec("P")
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


class Later(Generic[P, T]):
    """A function that is set after its callers are made."""

    def __init__(self) -> None:
        self._function = Current[Callable[P, T]]()
        self.set = self._function.set

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> T:
        return self._function()(*args, **kwargs)
