"""Two hundred addresses take as much as they can of every limited resource, and the robot does not notice.

Each test attacks a row of docs/reference/generated/quotas.md. A hundred guests may do everything below `/guest`,
and a hundred unknown hosts nothing.
"""

import contextlib
import struct
import threading
import time
import xmlrpc.client
from collections.abc import Iterator

import pytest

from examples.landshark.lab import Host, Lab
from roswire.tcpros import encode_header
from roswire.xmlrpc import FaultReceived
from tests.support.field import Impostor, answering
from tests.support.nodes import need_ros
from tests.support.requirements import need_root
from tests.support.siege import Siege
from tests.support.waiting import allowed

CONFIGURATION = """\
relay: {connections: 3000, connections_per_host: 1500}
limits: {parameter_bytes: 16777216}
api: 10.77.0.2:8443
api_networks: [10.77.0.0/16]
"""  # lower than by default, to reach the limits within seconds; other quotas and reserves in proportion
LONG_HEADER = struct.pack("<I", 60_000) + bytes(50_000)  # each of 60,000 bytes that never arrive
SLOW = 1.0  # seconds for a call of the robot during a flood, on an idle machine


def http_request(method: str, *parameters: str) -> bytes:
    body = xmlrpc.client.dumps(parameters, method).encode()
    return b"POST / HTTP/1.1\r\nContent-Length: %d\r\n\r\n%b" % (len(body), body)


@pytest.fixture(scope="module")
def siege(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Siege]:
    need_root()
    need_ros()
    with Lab("rosrv-test") as lab, Siege(lab, tmp_path_factory.mktemp("siege"), CONFIGURATION) as there:
        there.works(slowest=SLOW)
        yield there


@pytest.fixture(autouse=True)
def close_connections_first(siege: Siege) -> Iterator[None]:
    yield
    siege.crowd.leave()


def test_connections_of_two_hundred_addresses(siege: Siege) -> None:
    crowd = siege.crowd

    def attack() -> None:
        assert crowd.hold(crowd.guests[:12], 11311, each=520) > 4096
        crowd.hold(crowd.unknown_hosts, 11311, each=20)
        crowd.hold(crowd.guests, 11311, each=10, data=b"POST / HTTP/1.1\r\nContent-Length: 9\r\n\r\n<")

    siege.throughout(attack, slowest=SLOW)
    assert siege.trail.wait_for(event="limit exceeded")["host"].startswith("10.77.")


def test_requests_of_two_hundred_addresses(siege: Siege) -> None:
    crowd = siege.crowd
    ask = http_request("getSystemState", "/guest/asker")
    begun = b"POST / HTTP/1.1\r\nContent-Length: 8000000\r\n\r\n" + bytes(60_000)

    def attack() -> None:
        crowd.hold(crowd.guests, 11311, each=3, data=ask * 2)
        crowd.hold([*crowd.guests, *crowd.unknown_hosts], 11311, each=2, data=begun)

    siege.throughout(attack, slowest=3 * SLOW)  # a thousand at once, before the first call


def test_connections_to_the_relay(siege: Siege) -> None:
    crowd = siege.crowd
    port = max(crowd.subscribe(guest, "/guest/ear", "/voice", "/chatter") for guest in crowd.guests[:12])
    header = encode_header({
        "callerid": "/guest/ear", "topic": "/chatter", "type": "std_msgs/String", "md5sum": "*",
    })  # fmt: skip

    def attack() -> None:
        crowd.hold(crowd.guests[:12], port, each=20, data=header)
        assert crowd.hold(crowd.guests[:3], port, each=1200) > 3000
        crowd.hold(crowd.unknown_hosts, port, each=5, data=header[:-1])
        crowd.hold(crowd.guests[12:], port, each=2, data=LONG_HEADER)

    siege.throughout(attack, slowest=SLOW)


def test_handshakes_with_rest(siege: Siege) -> None:
    crowd, rest = siege.crowd, siege.ocu.run(siege.appliance.rest)
    before = siege.memory("api")

    def looks(host: Host = siege.ocu) -> float:
        begun = time.monotonic()
        assert host.run(lambda: rest.get("/v1/status").status) == 200
        return time.monotonic() - begun

    def attack() -> None:
        crowd.hold(crowd.guests[:1], 8443, each=1000)
        crowd.hold([*crowd.guests, *crowd.unknown_hosts], 8443, each=20)
        assert max(looks() for _ in range(10)) < allowed(SLOW)
        assert looks(siege.robot) < allowed(SLOW)  # its first request

    looks()
    siege.throughout(attack, slowest=SLOW)
    assert max(looks() for _ in range(10)) < allowed(SLOW)
    assert siege.memory("api") < before + (100 << 20)


def test_parameters_of_two_hundred_addresses(siege: Siege) -> None:
    crowd, ending, trees = siege.crowd, threading.Event(), list[int]()
    large, small = "x" * (1 << 18), {f"p{number}": number for number in range(2750)}

    def fill() -> None:
        refused = 0
        for number, guest in enumerate(crowd.guests):
            value = small if number % 2 else large
            answer = crowd.call(guest, "setParam", "/guest/n", f"/guest/{number}/map", value)
            refused += answer[0] != 1
            assert answer[0] == 1 or "bytes of parameters" in answer[1]
            assert crowd.call(guest, "setParam", "/guest/n", f"/guest/{number % 30 & ~1}/map", large)[0] == 1
        assert refused > 50
        for unknown in crowd.unknown_hosts[:20]:
            answer = crowd.call(unknown, "setParam", "/guest/n", "/guest/unknown", 1)
            assert isinstance(answer, FaultReceived)

    def read(guest: str) -> None:
        while not ending.is_set():
            with contextlib.suppress(OSError):
                trees.append(len(crowd.ask(guest, "getParam", "/guest/n", "/")))

    fill()
    refused = siege.trail.wait_for(
        lambda one: "bytes of parameters" in one["reason"], event="limit exceeded", decision="deny"
    )
    assert refused["host"].startswith("10.77.1.")
    readers = [threading.Thread(target=read, args=(guest,)) for guest in crowd.guests[:4]]
    for reader in readers:
        reader.start()
    try:
        siege.throughout(lambda: siege.parameters(large), slowest=SLOW)
    finally:
        ending.set()
        for reader in readers:
            reader.join()
    assert max(trees) > 8 << 20
    for number in range(30):
        assert siege.call("setParam", "/tidy", f"/guest/{number}/map", "y")[0] == 1
        assert siege.call("deleteParam", "/tidy", f"/guest/{number}")[0] == 1
    assert crowd.call(crowd.guests[99], "setParam", "/guest/n", "/guest/99/map", large)[0] == 1
    assert siege.call("deleteParam", "/tidy", "/guest")[0] == 1


def test_ports_and_names(siege: Siege) -> None:
    crowd = siege.crowd
    with Impostor(crowd.host, answering([1, "", 4711]), address="0.0.0.0") as nodes:

        def each(guest: str, number: int) -> tuple[str, str, str]:
            return (
                f"/guest/{guest.rpartition('.')[2]}_{number}",
                guest,
                f"http://{guest}:{nodes.port}/{number}",
            )

        def register(guest: str, number: int) -> bool:
            name, address, uri = each(guest, number)
            topic = ("/guest/topic", "std_msgs/String")
            return bool(crowd.call(address, "registerPublisher", name, *topic, uri)[0] == 1)

        taken: list[int] = []

        def attack() -> None:
            for guest in crowd.guests[:6]:
                taken.append(next(number for number in range(600) if not register(guest, number)))

        siege.throughout(attack, slowest=SLOW)
        assert 1650 < sum(taken) <= 1750, (
            "a node has three ports here, and guests have three quarters of 7000"
        )
        assert not register(crowd.guests[50], 0)
        for number in range(taken[0]):
            name, address, uri = each(crowd.guests[0], number)
            assert crowd.call(address, "unregisterPublisher", name, "/guest/topic", uri)[0] == 1
        assert register(crowd.guests[50], 0), "a host with nothing left did not free its slots at once"
