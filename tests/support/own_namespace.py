"""Isolation netns has one namespace and one lock per machine: tests that use it take turns."""

import contextlib
import fcntl
import tempfile
from collections.abc import Iterator
from pathlib import Path

_TURN = Path(tempfile.gettempdir()) / "rosrv-test-netns.lock"


@contextlib.contextmanager
def own_namespace() -> Iterator[None]:
    """Wait until no other test runs an appliance with isolation netns, the default of `rosrv up`."""
    with _TURN.open("w") as turn:
        fcntl.flock(turn, fcntl.LOCK_EX)
        yield
