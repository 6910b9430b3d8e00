"""Orders whose client does not wait for the answer any more: they are withdrawn before they take effect.

Invariants:

1. What carries out an order calls `take_effect` before it changes anything. It raises `WithdrawnError` when the client
   gave up before (its time is over, it disconnected, it was killed): nothing is changed then, and nothing will be.
2. After `take_effect` the order is carried out to its end, whatever its client does. So a client that was given no
   answer knows that nothing begins any more, and the audit log has what did.
3. What runs outside an order (a start, a signal, an automatic rollback) is never withdrawn; neither are tasks that an
   order left behind.

The order is a context variable: it is the same for everything that is awaited for one request, and for nothing else.
"""

import contextlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar

WITHDRAWN = "its client did not wait any longer, so the order was withdrawn before it took effect: nothing was changed"


class WithdrawnError(Exception):
    """The client of an order gave up before the order took effect: nothing was changed."""

    def __init__(self) -> None:
        super().__init__(WITHDRAWN)


class _Order:
    """`given_up()` says whether its client does not wait any more; `begun`: that does not matter any more."""

    def __init__(self, given_up: Callable[[], bool]) -> None:
        self.given_up = given_up
        self.begun = False


_PRESENT: ContextVar[_Order | None] = ContextVar("order", default=None)


@contextlib.contextmanager
def awaited(given_up: Callable[[], bool]) -> Iterator[None]:
    """Around what is done for one request; `given_up()` says whether its client does not wait any more."""
    order = _Order(given_up)
    before = _PRESENT.set(order)
    try:
        yield
    finally:
        order.begun = True  # tasks that it left behind have a copy of the variable
        _PRESENT.reset(before)


def require_awaited() -> None:
    """Raise `WithdrawnError` if the order's client gave up, and the order has not taken effect."""
    order = _PRESENT.get()
    if order is not None and not order.begun and order.given_up():
        raise WithdrawnError


def take_effect() -> None:
    """The order takes effect now, or raise `WithdrawnError`."""
    require_awaited()
    order = _PRESENT.get()
    if order is not None:
        order.begun = True
