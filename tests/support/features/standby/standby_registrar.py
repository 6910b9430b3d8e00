"""Change parameters and registrations without a pause, and remember each change that was answered.

    standby_registrar.py MASTER_URI OWN_ADDRESS

Each call is repeated until it is answered. The event `acknowledged` has the number of answered calls and the
monotonic time; it reports each 20th call, and after an input line `time` each call. The input line `check` compares
the master's state with all answers, and the event `checked` has the differences.
"""

import http.client
import itertools
import json
import os
import select
import sys
import threading
import time
import xmlrpc.client
import xmlrpc.server
from typing import Any
from xml.parsers.expat import ExpatError

NAME = "/registrar"
_KEYS, _TOPICS = 97, 23
_SECONDS = 2.0  # until a call counts as lost
_PAUSE = 0.02
_FULL = "the audit log cannot be written"  # refused: the disk of the active appliance is full


class Transport(xmlrpc.client.Transport):
    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = _SECONDS
        return connection


class Registrar:
    def __init__(self, master: str, own: str) -> None:
        self.master, self.own = master, own
        self.parameters: dict[str, int] = {}
        self.topics: set[str] = set()
        self.longest = 0.0
        self._proxy = xmlrpc.client.ServerProxy(master, Transport())

    def call(self, method: str, *arguments: Any) -> Any:
        began = time.monotonic()
        while True:
            try:
                status, text, value = getattr(self._proxy, method)(NAME, *arguments)
            except (OSError, http.client.HTTPException, ExpatError):
                self._proxy = xmlrpc.client.ServerProxy(self.master, Transport())
                select.select([], [], [], _PAUSE)
                continue
            if status != 1 and _FULL in text:
                select.select([], [], [], _PAUSE)
                continue
            if status != 1:
                raise RuntimeError(f"{method}{arguments}: {text}")
            self.longest = max(self.longest, time.monotonic() - began)
            return value

    def change(self, number: int) -> None:
        topic = f"/registrar/topic_{number % _TOPICS}"
        if number % 2:
            key = f"/registrar/key_{number % _KEYS}"
            self.call("setParam", key, number)
            self.parameters[key] = number
        elif topic in self.topics:
            self.call("unregisterPublisher", topic, self.own)
            self.topics.discard(topic)
        else:
            self.call("registerPublisher", topic, "std_msgs/String", self.own)
            self.topics.add(topic)

    def differences(self) -> list[str]:
        tree = self.call("getParam", "/registrar") if self.parameters else {}
        wrong = [
            f"{key} is {tree.get(key.rpartition('/')[2])}, not {value}"
            for key, value in self.parameters.items()
            if tree.get(key.rpartition("/")[2]) != value
        ]
        published = {topic for topic, nodes in self.call("getSystemState")[0] if NAME in nodes}
        wrong += [f"{topic} is missing" for topic in self.topics - published]
        return wrong + [f"{topic} is too many" for topic in published - self.topics]


def report(event: str, **fields: Any) -> None:
    sys.stdout.write(json.dumps({"event": event, **fields}) + "\n")
    sys.stdout.flush()


def serve(address: str) -> str:
    server = xmlrpc.server.SimpleXMLRPCServer((address, 0), logRequests=False)
    server.register_instance(_Node())
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return f"http://{address}:{server.server_address[1]}/"


class _Node:
    def _dispatch(self, method: str, _parameters: Any) -> list[Any]:
        return [1, "", os.getpid() if method == "getPid" else 0]


def main() -> None:
    registrar = Registrar(sys.argv[1], serve(sys.argv[2]))
    each = False
    for number in itertools.count(1):
        registrar.change(number)
        if number == 1:
            report("ready", name=NAME)
        if each or number % 20 == 0:
            report("acknowledged", number=number, at=time.monotonic(), longest=registrar.longest)
            registrar.longest = 0.0
        if select.select([sys.stdin], [], [], _PAUSE)[0]:
            line = sys.stdin.readline().strip()
            if not line:
                break
            each = line == "time"
            if line == "check":
                report("checked", differences=registrar.differences(), number=number)


if __name__ == "__main__":
    main()
