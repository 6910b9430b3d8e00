"""The delay that one host's large parameters cause for other hosts: `python -m benchmarks.large_values [--seconds 4]`.

A robot makes small calls while a guest sets large parameters, behind a plain `rosmaster` and behind the appliance.
"""

import argparse
import http.client
import statistics
import tempfile
import threading
import time
import xmlrpc.client
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.rosmaster import PlainMaster

_ROBOT, _GUEST = "127.0.0.1", "127.0.0.2"
_PAUSE = 0.005
VALUES: dict[str, Callable[[], Any]] = {
    "8 MB of text": lambda: "x" * (8 << 20),
    "500,000 numbers": lambda: list(range(500_000)),
    "150,000 members": lambda: {f"member_{number}": number for number in range(150_000)},
}


class Caller:
    def __init__(self, port: int, address: str) -> None:
        self._connection = http.client.HTTPConnection("127.0.0.1", port, 120, source_address=(address, 0))

    def send(self, body: bytes) -> None:
        self._connection.request("POST", "/", body, {"Content-Type": "text/xml"})
        answer = self._connection.getresponse()
        answer.read()
        if answer.status != 200:
            raise RuntimeError(f"HTTP status {answer.status}")


def delays(port: int, seconds: float, large: bytes | None) -> tuple[list[float], int]:
    """Return the milliseconds of a robot's calls while a guest sends `large`, and the number of times it did."""
    stop, sent = threading.Event(), [0]

    def flood() -> None:
        guest = Caller(port, _GUEST)
        while large is not None and not stop.is_set():
            guest.send(large)
            sent[0] += 1

    thread = threading.Thread(target=flood)
    thread.start()
    robot, measured, pause = Caller(port, _ROBOT), list[float](), threading.Event()
    calls = [_call("getParam", "/robot", "/speed"), _call("lookupNode", "/robot", "/rosout")]
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        began = time.perf_counter()
        robot.send(calls[len(measured) % 2])
        measured.append(1000 * (time.perf_counter() - began))
        pause.wait(_PAUSE)
    stop.set()
    thread.join()
    return measured, sent[0]


def _call(method: str, *params: Any) -> bytes:
    return xmlrpc.client.dumps(params, method).encode()


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Measure the delay that one host's large parameters cause for the others"
    )
    parser.add_argument("--seconds", type=float, default=4.0, help="of each measurement")
    seconds = parser.parse_args().seconds
    table = Table("master", "a guest sets", "p50 ms", "p99 ms", "longest ms", "sets")
    with (
        tempfile.TemporaryDirectory() as home,
        PlainMaster(Path(home)) as plain,
        Appliance(policy=OPEN_POLICY) as ours,
    ):
        for name, uri in (("plain", plain.master_uri), ("appliance", ours.master_uri)):
            port = int(uri.rstrip("/").rpartition(":")[2])
            Caller(port, _ROBOT).send(_call("setParam", "/robot", "/speed", 1))
            for what, value in (("nothing", None), *VALUES.items()):
                large = None if value is None else _call("setParam", "/guest", "/guest/large", value())
                measured, sent = delays(port, seconds, large)
                measured.sort()
                figures = statistics.median(measured), measured[int(len(measured) * 0.99)], measured[-1]
                table.add_row(name, what, *(f"{one:.1f}" for one in figures), str(sent))
    Console().print(table)


if __name__ == "__main__":
    main()
