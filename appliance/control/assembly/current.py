"""Values that are set after the parts of control that need them are made, and services that features provide."""

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


class Provided(Generic[T]):
    """A service that at most one feature provides."""

    def __init__(self) -> None:
        self._service: T | None = None

    def provide(self, service: T) -> None:
        """Raises `RuntimeError` if another feature provides the service."""
        if self._service is not None:
            raise RuntimeError("two features provide the same service of control")
        self._service = service

    def __call__(self) -> T | None:
        return self._service
