"""Run a robot at work while two hundred addresses try to exhaust every resource.

The appliance is 10.77.0.2, the robot 10.77.0.10, its operator 10.77.0.20. The crowd has a hundred guest addresses,
which may do anything below `/guest`, and a hundred unknown hosts, which no rule names.
"""

import contextlib
import resource
import select
import socket
import time
import xmlrpc.client
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Self

from examples.landshark.lab import Host, Lab
from roswire.xmlrpc import FaultReceived, parse_response
from tests.support.appliance import Appliance
from tests.support.command import ROSRV
from tests.support.nodes import RosSession, numbers, without_gap
from tests.support.processes import LIMIT, Process, ThisMachine
from tests.support.waiting import allowed

POLICY = """\
[Groups]
team = 10.77.0.10 10.77.0.20
guests = 10.77.1.0/24
[Nodes]
default = team
/guest/** = team guests
[Publishers]
default = team
/guest/** = team guests
[Subscribers]
default = team
/guest/** = team guests
/chatter = team guests
[Services]
default = team
/guest/** = team guests
[Clients]
default = team
/guest/** = team guests
[Parameters]
read default = team guests
write default = team
write /guest/** = team guests
[Commands]
default = team guests
"""
APPLIANCE = "10.77.0.2"
_BURST = 256  # simultaneous connections in progress


class Crowd:
    def __init__(self, lab: Lab) -> None:
        self.guests = [f"10.77.1.{number}" for number in range(1, 101)]
        self.unknown_hosts = [f"10.77.2.{number}" for number in range(1, 101)]
        everybody = [f"{address}/16" for address in (*self.guests, *self.unknown_hosts)]
        self.host: Host = lab.host("crowd", *everybody)
        self.held: list[socket.socket] = []

    def hold(
        self,
        addresses: Sequence[str],
        port: int,
        *,
        each: int,
        data: bytes = b"",
    ) -> int:
        before = len(self.held)
        self.host.run(lambda: self._connect([one for _ in range(each) for one in addresses], port, data))
        return len(self.held) - before

    def _connect(self, addresses: list[str], port: int, data: bytes) -> None:
        for start in range(0, len(addresses), _BURST):
            coming = []
            for address in addresses[start : start + _BURST]:
                sock = socket.socket()
                sock.setblocking(False)
                # The kernel chooses a free port once it knows the other end, so that each address can use all ports.
                sock.setsockopt(socket.IPPROTO_IP, 24, 1)  # IP_BIND_ADDRESS_NO_PORT
                sock.bind((address, 0))
                sock.connect_ex((APPLIANCE, port))
                coming.append(sock)
            waiting = set(coming)
            deadline = time.monotonic() + allowed(1.0)  # packets that the firewall drops are not answered
            while waiting and time.monotonic() < deadline:
                poll = select.poll()
                by_number = {sock.fileno(): sock for sock in waiting}
                for number in by_number:
                    poll.register(number, select.POLLOUT)
                for number, _events in poll.poll(100):
                    sock = by_number[number]
                    waiting.discard(sock)
                    with contextlib.suppress(OSError):
                        sock.send(data)
            for sock in waiting:
                sock.close()
            self.held += [sock for sock in coming if sock not in waiting]

    def subscribe(self, address: str, caller_id: str, publisher: str, topic: str) -> int:
        face = self.call(address, "lookupNode", caller_id, publisher)
        assert face[0] == 1, face
        port = int(face[2].rstrip("/").rpartition(":")[2])
        answer = self.call(address, "requestTopic", caller_id, topic, [["TCPROS"]], port=port)
        assert answer[0] == 1, answer
        return int(answer[2][2])

    def leave(self) -> None:
        for sock in self.held:
            sock.close()
        self.held.clear()

    def call(self, address: str, method: str, *parameters: Any, port: int = 11311) -> Any:
        answer = self.ask(address, method, *parameters, port=port)
        try:
            return parse_response(answer.partition(b"\r\n\r\n")[2])
        except FaultReceived as fault:
            return fault

    def ask(self, address: str, method: str, *parameters: Any, port: int = 11311) -> bytes:
        body = xmlrpc.client.dumps(parameters, method).encode()
        data = b"POST / HTTP/1.1\r\nConnection: close\r\nContent-Length: %d\r\n\r\n%b" % (len(body), body)

        def exchange() -> bytes:
            with socket.create_connection((APPLIANCE, port), LIMIT, source_address=(address, 0)) as sock:
                sock.sendall(data)
                received = bytearray()
                while piece := sock.recv(1 << 20):
                    received += piece
                return bytes(received)

        return self.host.run(exchange)


class Siege:
    def __init__(self, lab: Lab, home: Path, settings: str) -> None:
        self.middle = lab.host("appliance", f"{APPLIANCE}/16")
        self.robot = lab.host("robot", "10.77.0.10/16")
        self.ocu = lab.host("ocu", "10.77.0.20/16")
        self.crowd = Crowd(lab)
        self.home = home
        self.appliance = Appliance(self.middle, policy=POLICY, settings=settings, relays=2)
        self._closing = contextlib.ExitStack()

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
            stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
            stack.enter_context(self.appliance)
            stack.callback(self.crowd.leave)
            # The last 1,000 lines include records from before the audit log could be queried.
            tail = ("audit", "tail", "--lines", "1000", "--json")
            command = [ROSRV, *tail, "--state", str(self.appliance.state)]
            self.trail = stack.enter_context(
                Process(ThisMachine(), command, env={"PYTHONUNBUFFERED": "1"}, label="audit tail")
            )
            self.ros = stack.enter_context(RosSession(self.appliance.master_uri, self.home, self.robot))
            self.talker = self.ros.talker("rospy", "/chatter", "--rate", "50", name="voice")
            self.listener = self.ros.on(self.ocu).listener("roscpp", "/chatter", name="ear")
            self.server = self.ros.service_server("roscpp", "/negate", name="negator")
            self.client = self.ros.on(self.ocu).service_client("rospy", "/negate", name="asker")
            self.listener.wait_for(event="received")
            self._closing = stack.pop_all()
        return self

    def __exit__(self, *exc: object) -> None:
        self._closing.close()

    def calls(self, count: int = 50) -> float:
        def each() -> float:
            begun = time.monotonic()
            server: Any = xmlrpc.client.ServerProxy(self.appliance.master_uri)
            with server:
                assert server.getParam("/looker", "/rosdistro")[0] == 1
            return time.monotonic() - begun

        return self.robot.run(lambda: max(each() for _ in range(count)))

    def call(self, method: str, *parameters: Any) -> Any:
        def make() -> Any:
            with xmlrpc.client.ServerProxy(self.appliance.master_uri) as server:
                return server.__getattr__(method)(*parameters)

        return self.robot.run(make)

    def parameters(self, large: str) -> None:
        for number in range(50):
            assert self.call("setParam", "/starter", f"/robot/gains/{number}", number)[0] == 1
        for value in (large, large, {"description": large}):
            assert self.call("setParam", "/starter", "/robot/model", value)[0] == 1
        assert self.call("getParam", "/starter", "/robot/model")[2] == {"description": large}
        assert self.call("deleteParam", "/starter", "/robot")[0] == 1

    def works(self, *, slowest: float, messages: int = 25) -> None:
        heard = len(self.listener.seen(event="received"))
        took = self.calls()
        assert took < allowed(slowest), f"the robot's call took {took:.2f} s"
        answered = len(self.client.seen(event="answered"))
        for _ in range(5):
            self.client.send("true")
        self.client.wait_for_count(answered + 5, event="answered")
        assert not self.client.seen(event="failed")
        late = self.ros.on(self.ocu).listener("rospy", "/chatter")
        late.wait_for(event="received")
        late.stop()
        self.unharmed(heard, messages)

    def unharmed(self, before: int, messages: int) -> None:
        count = max(before, len(self.listener.seen(event="received"))) + messages
        heard = self.listener.wait_for_count(count, event="received")[before:]
        assert without_gap(numbers(heard)), "messages are missing or repeated"

    def memory(self, role: str) -> int:
        pid = self.appliance.pids(role)[0]
        status = Path(f"/proc/{pid}/status").read_text()
        return int(status.partition("VmRSS:")[2].split()[0]) << 10

    def reload(self) -> None:
        self.appliance.rosrv("policy", "reload")

    def throughout(self, attack: Callable[[], None], *, slowest: float) -> None:
        attack()
        self.works(slowest=slowest)
        self.reload()
        self.works(slowest=slowest)
