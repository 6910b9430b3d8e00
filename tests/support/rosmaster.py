import socket
import threading
import time
import xmlrpc.client
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

from tests.support.nodes import RosSession
from tests.support.processes import LIMIT, Host, Process, ThisMachine

PORT = 11311


class PlainMaster:
    def __init__(self, home: Path, host: Host | None = None) -> None:
        self.host: Host = host or ThisMachine()
        self.home = home
        self.processes: list[Process] = []
        self.master_uri = ""

    def start(self) -> Self:
        port = free_port() if isinstance(self.host, ThisMachine) else PORT
        self.master_uri = f"http://{self.host.address}:{port}"
        session = RosSession(self.master_uri, self.home, self.host)
        self.processes = session.processes
        master = session.start(["/usr/bin/rosmaster", "--core", "-p", str(port)], label="rosmaster")
        await_master(self.master_uri, self.host, master)
        session.run("rosparam", "set", "/run_id", "plain")
        session.start(["/usr/lib/rosout/rosout", "__name:=rosout"], label="rosout")
        await_node(self.master_uri, self.host, "/rosout")
        return self

    def stop(self) -> None:
        for process in reversed(self.processes):
            process.stop()

    def story(self) -> str:
        return "\n".join(process.story() for process in self.processes)

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *exc: object) -> None:
        self.stop()


def master_at(uri: str) -> Any:
    """Return a proxy without types, because the type stubs of `xmlrpc.client` lack answers that are lists."""
    return xmlrpc.client.ServerProxy(uri, allow_none=True)


def call_on(host: Host, uri: str, method: str, *parameters: Any) -> Any:
    run = getattr(host, "run", None)

    def call() -> Any:
        with master_at(uri) as server:
            return getattr(server, method)(*parameters)

    return run(call) if run is not None else call()


def await_master(uri: str, host: Host, process: Process) -> None:
    _await(lambda: call_on(host, uri, "getPid", "/test"), f"no master answers at {uri}", process)


def await_node(uri: str, host: Host, name: str) -> None:
    def lookup() -> None:
        status, message, _ = call_on(host, uri, "lookupNode", "/test", name)
        if status != 1:
            raise OSError(message)

    _await(lookup, f"no node {name} at {uri}", None)


def _await(attempt: Callable[[], object], complaint: str, process: Process | None) -> None:
    deadline = time.monotonic() + LIMIT
    pause = threading.Event()
    while True:
        try:
            attempt()
        except OSError as error:
            gone = process is not None and not process.running
            if gone or time.monotonic() > deadline:
                raise AssertionError(f"{complaint}: {error}\n{process.story() if process else ''}") from error
        else:
            return
        pause.wait(0.05)


def free_port() -> int:
    """Return a port that was just free, for programs that do not accept port 0. The kernel does not reuse it soon."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
