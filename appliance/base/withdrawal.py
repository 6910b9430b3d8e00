"""Withdraw an order before it takes effect if its client no longer waits for the answer.

Invariants:

1. Every order calls `take_effect` before its first change. `take_effect` raises `WithdrawnError` if the client gave up
   earlier (timeout, disconnection, kill). A withdrawn order changes nothing, now or later.
2. After `take_effect`, the order runs to its end even if its client gives up.
3. The audit log lists every order that started.
4. Work outside an order (a start, a signal, an automatic rollback) is never withdrawn. Tasks that outlive their order
   are not withdrawn either.

The current order is a context variable, so all code that runs for one request sees the same order.
"""

import contextlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar

WITHDRAWN = (
    "the client stopped waiting, so the change was withdrawn before it took effect: nothing was changed"
)


class WithdrawnError(Exception):
    """The client gave up before its order changed anything."""

    def __init__(self) -> None:
        super().__init__(WITHDRAWN)


class _Order:
    """`given_up()` no longer matters once `begun` is true."""

    def __init__(self, given_up: Callable[[], bool]) -> None:
        self.given_up = given_up
        self.begun = False


_PRESENT: ContextVar[_Order | None] = ContextVar("order", default=None)


@contextlib.contextmanager
def awaited(given_up: Callable[[], bool]) -> Iterator[None]:
    """Run the block as an order; `given_up()` returns whether its client stopped waiting."""
    order = _Order(given_up)
    before = _PRESENT.set(order)
    try:
        yield
    finally:
        order.begun = True  # tasks that outlive the order have a copy of the variable
        _PRESENT.reset(before)


def require_awaited() -> None:
    """Raise `WithdrawnError` if the client gave up before the order took effect."""
    order = _PRESENT.get()
    if order is not None and not order.begun and order.given_up():
        raise WithdrawnError


def take_effect() -> None:
    """Mark the present order as begun. Raises `WithdrawnError` if the client gave up."""
    require_awaited()
    order = _PRESENT.get()
    if order is not None:
        order.begun = True
