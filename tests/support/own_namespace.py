"""Isolation netns has one namespace and one lock a machine: tests that start it on this machine take turns."""

import contextlib
import fcntl
import tempfile
from collections.abc import Iterator
from pathlib import Path

_TURN = Path(tempfile.gettempdir()) / "rosrv-test-netns.lock"


@contextlib.contextmanager
def own_namespace() -> Iterator[None]:
    """Wait until no other test has an appliance with isolation netns, which is what `rosrv up` takes by itself."""
    with _TURN.open("w") as turn:
        fcntl.flock(turn, fcntl.LOCK_EX)
        yield
