import contextlib
import fcntl
import os
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

from appliance.network import interfaces
from appliance.network.namespaces import Namespace

_TURN = Path(tempfile.gettempdir()) / "rosrv-test-netns.lock"


@contextlib.contextmanager
def own_namespace() -> Iterator[None]:
    with _TURN.open("w") as turn:
        left = signal.setitimer(signal.ITIMER_REAL, 0)  # other tests' turns are not this test's time
        fcntl.flock(turn, fcntl.LOCK_EX)
        signal.setitimer(signal.ITIMER_REAL, *left)
        yield


@contextlib.contextmanager
def own_loopback() -> Iterator[None]:
    namespace = Namespace(f"rosrv-test-loopback.{os.getpid()}").create()
    with namespace.inside():
        interfaces.set_link(Namespace.own(), "lo", up=True)
        namespace.delete()  # only the name: it ends with the last process in it
        yield
