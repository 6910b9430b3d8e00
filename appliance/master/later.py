"""A part that others call before it is made: parts of control that need each other are made one after the other."""

from typing import Generic, TypeVar

T = TypeVar("T")


class Later(Generic[T]):
    """Holds one part; calling it gives the part. Filled once, while control is assembled."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._part: T | None = None

    def __call__(self) -> T:
        """The part. Raises `RuntimeError` when it is asked for before it was made."""
        if self._part is None:
            raise RuntimeError(f"{self._name} is not made yet")
        return self._part

    def fill(self, part: T) -> T:
        """This is the part from now on; gives it back."""
        self._part = part
        return part
