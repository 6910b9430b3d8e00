"""Withdraw an order before it takes effect if its client no longer waits for the answer.

Every order calls `take_effect` before its first change. A withdrawn order changes nothing, now or later; after
`take_effect`, it runs to its end. Work outside an order, and tasks that outlive it, are never withdrawn.
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
    """An order of a client; `given_up()` no longer matters once `begun` is true."""

    def __init__(self, given_up: Callable[[], bool], host: str) -> None:
        self.given_up = given_up
        self.host = host
        self.begun = False


_PRESENT: ContextVar[_Order | None] = ContextVar("order", default=None)


@contextlib.contextmanager
def withdrawable(given_up: Callable[[], bool], host: str = "") -> Iterator[None]:
    """Run the block as an order that its client can give up; `given_up()` returns whether it has."""
    order = _Order(given_up, host)
    before = _PRESENT.set(order)
    try:
        yield
    finally:
        order.begun = True  # tasks that outlive the order have a copy of the variable
        _PRESENT.reset(before)


def caller_host() -> str:
    """Return the address from which the order came over REST; empty for the admin socket."""
    order = _PRESENT.get()
    return "" if order is None else order.host


def require_awaited() -> None:
    """Raise `WithdrawnError` if the client gave up before the order took effect."""
    order = _PRESENT.get()
    if order is not None and not order.begun and order.given_up():
        raise WithdrawnError


def take_effect() -> None:
    """Begin the changes of the order, which is then never withdrawn. Raises `WithdrawnError`."""
    require_awaited()
    order = _PRESENT.get()
    if order is not None:
        order.begun = True
