"""A robot that starts, beside plain `rosmaster`: `python -m benchmarks.control_plane_start [--rounds 5]`.

In each round, both masters are new and take turns.

- `parameters`: roslaunch clears a namespace and sets 4,000 parameters below it, in one multicall.
- `nodes`: 100 nodes at once publish ten topics each and subscribe to ten of the next one, each over a kept connection
  as with roscpp. The start is over when every call is answered and every subscriber knows its publishers.

The table has medians of the rounds: the seconds until the start is over, and the processor time in seconds, which for
RVMaster includes the master that it hides. A ratio above 1 means that RVMaster is slower.
"""

import argparse
import os
import select
import socket
import statistics
import time
import xmlrpc.client
from collections.abc import Callable

from rich.console import Console
from rich.table import Table

from benchmarks.control_plane import Client, Master, masters, processor_seconds, request
from roswire.xmlrpc import XmlRpcLimits, parse_call

PARAMETERS, NODES, TOPICS = (
    4000,
    100,
    10,
)  # topics that each node publishes, and the number that it subscribes to
TYPE = "std_msgs/String"
ACKNOWLEDGED = xmlrpc.client.dumps(([1, "", 0],), methodresponse=True).encode()
PATIENCE = 120.0  # seconds without any progress


def parameters(port: int) -> float:
    names = [f"/start/part_{one // 50}/value_{one % 50}" for one in range(PARAMETERS)]
    calls: list[tuple[str, list[str | int]]] = [("deleteParam", ["/roslaunch", "/start"])]
    calls += [("setParam", ["/roslaunch", name, place]) for place, name in enumerate(names)]
    wanted = request(
        "system.multicall", [{"methodName": name, "params": given} for name, given in calls], keep=True
    )
    client = Client(port, [wanted], keep=True)
    sock = client.send()
    while not client.receive():
        pass
    sock.close()
    with xmlrpc.client.ServerProxy(f"http://127.0.0.1:{port}/") as master:
        there = master.getParam("/check", "/start")
    assert isinstance(there, list)
    assert sum(map(len, there[2].values())) == PARAMETERS
    return client.delays[0]


class Node:
    def __init__(self, master: int, number: int) -> None:
        self.listening = socket.create_server(("127.0.0.1", 0), backlog=64)
        me, following = f"/start/node_{number}", (number + 1) % NODES
        own = f"http://127.0.0.1:{self.listening.getsockname()[1]}/"
        mine, others = (
            [f"/start/part_{part}/topic_{one}" for one in range(TOPICS)] for part in (number, following)
        )
        self.calls = [
            *(request("registerPublisher", me, topic, TYPE, own, keep=True) for topic in mine),
            *(request("registerSubscriber", me, topic, TYPE, own, keep=True) for topic in others),
        ]
        self._wanted = others
        self.known: set[str] = set()  # topics for which it knows a publisher
        self.client = Client(master, self.calls, keep=True)

    def answered(self, answer: bytes) -> None:
        place = len(self.client.delays) - 1 - TOPICS
        if 0 <= place < TOPICS and b"http://" in answer:
            self.known.add(self._wanted[place])

    def told(self, body: bytes) -> None:
        call = parse_call(body, XmlRpcLimits())
        if call.method == "publisherUpdate" and call.params[2]:
            self.known.add(str(call.params[1]))

    @property
    def done(self) -> bool:
        return len(self.client.delays) >= len(self.calls) and len(self.known) == TOPICS


class Told:
    def __init__(self, node: Node) -> None:
        self._node = node
        self.sock, _ = node.listening.accept()
        self.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._buffer = b""

    def receive(self) -> bool:
        piece = self.sock.recv(1 << 16)
        self._buffer += piece
        head, mark, body = self._buffer.partition(b"\r\n\r\n")
        if mark and len(body) >= int(head.lower().partition(b"content-length:")[2].split(b"\r\n")[0]):
            self._node.told(body)
            self._buffer = b""
            reply = b"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nContent-Length: %d\r\n\r\n%b"
            self.sock.sendall(reply % (len(ACKNOWLEDGED), ACKNOWLEDGED))
        return bool(piece)


def nodes(port: int) -> float:
    group = [Node(port, number) for number in range(NODES)]
    poll = select.epoll()
    listening = {node.listening.fileno(): node for node in group}
    calling: dict[int, Node] = {}
    told: dict[int, Told] = {}

    def go(node: Node) -> None:
        sock = node.client.send()
        if sock.fileno() not in calling:
            calling[sock.fileno()] = node
            poll.register(sock, select.EPOLLIN)

    def serve(descriptor: int) -> None:
        if descriptor in listening:
            one = Told(listening[descriptor])
            told[one.sock.fileno()] = one
            poll.register(one.sock, select.EPOLLIN)
        elif descriptor in told:
            if not told[descriptor].receive():
                told.pop(descriptor).sock.close()
        elif calling[descriptor].client.receive():
            node = calling[descriptor]
            node.answered(node.client.answer)
            if len(node.client.delays) < len(node.calls):
                go(node)

    def until(over: Callable[[], bool]) -> None:
        while not over():
            events = poll.poll(PATIENCE)
            if not events:
                raise TimeoutError("the nodes wait for a master that says nothing")
            for descriptor, _event in events:
                serve(descriptor)

    for descriptor in listening:
        poll.register(descriptor, select.EPOLLIN)
    began = time.perf_counter()
    for node in group:
        go(node)
    until(lambda: all(node.done for node in group))
    taken = time.perf_counter() - began
    poll.close()
    for node in group:
        node.listening.close()
        if node.client.sock is not None:
            node.client.sock.close()
    for connection in told.values():
        connection.sock.close()
    return taken


def timed(start: Callable[[int], float], master: Master) -> tuple[float, float]:
    before = processor_seconds(master.pids)
    return start(master.port), processor_seconds(master.pids) - before


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    given = parser.parse_args()
    table = Table(
        "start", "", "rosmaster", "RVMaster", "ratio", title=f"load average {os.getloadavg()[0]:.1f}"
    )
    runs: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for _ in range(given.rounds):
        with masters() as (plain, ours):
            for start in (parameters, nodes):
                pairs = zip(timed(start, plain), timed(start, ours), strict=True)
                for what, pair in zip(("s", "processor s"), pairs, strict=True):
                    runs.setdefault((start.__name__, what), []).append(pair)
    for names, measured in runs.items():
        seconds = [f"{statistics.median(side):.2f}" for side in zip(*measured, strict=True)]
        table.add_row(*names, *seconds, f"{statistics.median(b / a for a, b in measured):.1f}")
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
