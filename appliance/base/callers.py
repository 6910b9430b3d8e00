"""The address from which an order came, while it is carried out."""

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar

_HOST: ContextVar[str] = ContextVar("host of the caller", default="")


@contextlib.contextmanager
def called_from(host: str) -> Iterator[None]:
    before = _HOST.set(host)
    try:
        yield
    finally:
        _HOST.reset(before)


def caller_host() -> str:
    """Return the address of the REST client; empty for the admin socket."""
    return _HOST.get()
