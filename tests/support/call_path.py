"""Print the files that one registerPublisher enters in control, one a line, in the order of the first entry.

    python -m tests.support.call_path FOLDER    # with a network that is only a loopback

A control with a real rosmaster runs in a thread of this program, which profiles all its threads. A file is listed if
each of `_CALLS` calls enters it. Work that goes on without calls (`run_always`) does not count.
"""

import http.client
import socket
import sys
import threading
import xmlrpc.client
from collections.abc import Awaitable, Callable
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from types import FrameType
from xmlrpc.server import SimpleXMLRPCServer

import uvloop

from appliance.audit.log.log_database import reading
from appliance.base.background import run_always
from appliance.channel import messages
from appliance.configuration.settings import Settings
from appliance.control import process as control_process
from appliance.control.process import _run as run_control
from appliance.network import interfaces
from appliance.network.namespaces import Namespace
from tests.support.nodes import RosSession
from tests.support.processes import ThisMachine
from tests.support.relay_driver import ChannelPeer
from tests.support.rosmaster import await_master, master_at
from tests.support.sources import ROOT
from tests.support.waiting import eventually

APPLIANCE, HOST = "10.99.0.1", "10.99.0.2"
POLICY = f"[Nodes]\n/node* = {HOST}\n[Publishers]\n/topic* = {HOST}\n[Subscribers]\n/topic* = {HOST}\n"
_PORT, _ROSMASTER_PORT = 11311, 11312
_ROSMASTER = f"http://127.0.0.1:{_ROSMASTER_PORT}"
_CALLS = 12
_TYPE = "std_msgs/String"
_GOES_ON = ContextVar("_GOES_ON", default=False)


class Profiler:
    def __init__(self) -> None:
        self.on = False
        self.entered: dict[str, None] = {}

    def __call__(self, frame: FrameType, event: str, _argument: object) -> None:
        name = frame.f_code.co_filename
        if self.on and event == "call" and name not in self.entered and not _GOES_ON.get():
            self.entered[name] = None

    def take(self) -> list[str]:
        entered, self.entered = self.entered, {}
        paths = (name.removeprefix(f"{ROOT}/") for name in entered)
        return [
            path.removeprefix("appliance/") for path in paths if path.startswith(("appliance/", "roswire/"))
        ]


async def _run_always(what: str, work: Callable[[], Awaitable[object]]) -> None:
    _GOES_ON.set(True)
    await run_always(what, work)


class Control:
    def __init__(self, home: Path, profiler: Profiler) -> None:
        self.state = home / "state"
        policy = home / "policy.ini"
        policy.write_text(POLICY, encoding="utf-8")
        (self.state / "control").mkdir(parents=True)
        self._settings = Settings(
            policy=policy,
            state=self.state,
            listen=f"{APPLIANCE}:{_PORT}",
            rosmaster_port=_ROSMASTER_PORT,
            isolation="none",
            api="off",
            hosts=self.state / "hosts.yaml",
            relays=1,
        )
        here, there = socket.socketpair()
        relays, controls = socket.socketpair()
        self._descriptor = there.detach()
        self._relay = ChannelPeer(relays, messages.RelayLink)
        self._lifeline = ChannelPeer(here, messages.Lifeline, self._heard)
        self._lifeline.send(messages.SocketsRestored(0, False))
        self._lifeline.send(messages.LinkOpened("relay", 0), (controls.detach(),))
        threading.setprofile(profiler)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        self._lifeline.wait_for(lambda message: isinstance(message, messages.Ready))

    def _run(self) -> None:
        control_process.run_always = _run_always  # type: ignore[attr-defined]  # imported there
        uvloop.run(run_control(self._settings, self._descriptor, self.state / "config.json"))

    def _heard(self, message: messages.Message) -> None:
        if isinstance(message, messages.RouteWanted):
            self._lifeline.send(messages.RouteFound(message.host, APPLIANCE))

    def recorded(self, resource: str) -> bool:
        with reading(self.state / "control" / "audit.db") as log:
            question = "SELECT count(*) FROM record WHERE resource = ? AND category = 'publish'"
            return bool(log.execute(question, (resource,)).fetchone()[0])

    def close(self) -> None:
        self._lifeline.send(messages.Stop())
        self._thread.join()
        self._lifeline.close()
        self._relay.close()


class Caller(xmlrpc.client.Transport):
    def __init__(self, name: str) -> None:
        super().__init__()
        self.name = name
        self.updates = 0
        self._server = SimpleXMLRPCServer((HOST, 0), logRequests=False)
        self._server.register_function(self._update, "publisherUpdate")
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def make_connection(self, _host: object) -> http.client.HTTPConnection:
        return http.client.HTTPConnection(APPLIANCE, _PORT, source_address=(HOST, 0))

    def register(self, method: str, topic: str) -> None:
        uri = f"http://{HOST}:{self._server.server_address[1]}/"
        with xmlrpc.client.ServerProxy(f"http://{APPLIANCE}:{_PORT}", transport=self) as master:
            answer = getattr(master, method)(self.name, topic, _TYPE, uri)
        assert answer[0] == 1, answer

    def _update(self, *_arguments: object) -> list[object]:
        self.updates += 1
        return [1, "", 0]


def path_of_a_call(folder: Path) -> list[str]:
    for address in (APPLIANCE, HOST):
        interfaces.add_address(Namespace.own(), "lo", f"{address}/32")
    with RosSession(_ROSMASTER, folder, ThisMachine()) as ros:
        rosmaster = ros.start(["/usr/bin/rosmaster", "--core", "-p", str(_ROSMASTER_PORT)], label="rosmaster")
        await_master(_ROSMASTER, ros.host, rosmaster)
        pairs = [(Caller(f"/node{number}"), Caller(f"/node{number}s")) for number in range(_CALLS)]
        profiler = Profiler()
        control = Control(folder, profiler)
        paths = [_path(profiler, control, f"/topic{number}", *pair) for number, pair in enumerate(pairs)]
        control.close()
    return [path for path in paths[0] if all(path in other for other in paths)]


def _path(
    profiler: Profiler, control: Control, topic: str, publisher: Caller, subscriber: Caller
) -> list[str]:
    subscriber.register("registerSubscriber", topic)
    eventually(partial(_rosmaster_has, 1, topic, subscriber.name), f"rosmaster knows {subscriber.name}")
    profiler.on = True
    publisher.register("registerPublisher", topic)
    eventually(lambda: subscriber.updates, f"{subscriber.name} learns of the publisher")
    eventually(partial(_rosmaster_has, 0, topic, publisher.name), f"rosmaster knows {publisher.name}")
    eventually(partial(control.recorded, topic), f"{topic} is recorded")
    profiler.on = False
    return profiler.take()


def _rosmaster_has(kind: int, topic: str, name: str) -> bool:
    with master_at(_ROSMASTER) as master:
        return [topic, [name]] in master.getSystemState("/test")[2][kind]


if __name__ == "__main__":
    print("\n".join(path_of_a_call(Path(sys.argv[1]))), flush=True)  # noqa: T201  the result of a program
