import contextlib
import errno
import os
import resource
import socket
from pathlib import Path

import pytest

from appliance.network.namespaces import NetworkError
from appliance.network.scan import addresses_of, scan

OPEN, REFUSED, SILENT = 0, errno.ECONNREFUSED, errno.ETIMEDOUT


@pytest.mark.nightly
def test_open_and_refused_ports_differ() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        listening, bound = server.getsockname()[1], closed.getsockname()[1]
        result = scan("127.0.0.1", [listening, bound], seconds=10)
    assert (result.open, result.refused, result.silent, result.answered) == ((listening,), 1, 0, True)


@pytest.mark.nightly
def test_few_file_descriptors_make_a_scan_slower_without_an_error() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with socket.create_server(("127.0.0.1", 0), backlog=500) as server, contextlib.ExitStack() as others:
        for _ in range(50):
            others.enter_context(Path("/dev/null").open())
        open_now = max(int(entry.name) for entry in Path("/proc/self/fd").iterdir())
        resource.setrlimit(resource.RLIMIT_NOFILE, (open_now + 20, hard))
        try:
            result = scan("127.0.0.1", [server.getsockname()[1]] * 300, seconds=10)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert len(result.open) == 300


class Stuck(socket.socket):
    number = errno.ENETUNREACH

    def connect_ex(self, _address: object) -> int:
        return self.number

    def connect(self, address: object) -> None:
        raise OSError(self.connect_ex(address), "stuck")


@pytest.mark.nightly
@pytest.mark.parametrize("number", [errno.ENETUNREACH, errno.EPERM, errno.EACCES, errno.EHOSTUNREACH])
def test_a_port_that_could_not_be_tried_is_neither_open_nor_closed(
    monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    monkeypatch.setattr("appliance.network.scan.socket.socket", Stuck)
    monkeypatch.setattr(Stuck, "number", number)
    result = scan("192.0.2.7", [1, 2, 3], seconds=10)
    assert (result.open, result.refused, result.silent, result.untried) == ((), 0, 0, 3)
    assert not result.answered
    assert result.obstacle == os.strerror(number)


@pytest.mark.nightly
@pytest.mark.parametrize("number", [errno.EADDRNOTAVAIL, errno.EINVAL])
def test_an_unusable_address_is_an_error_with_the_reason(
    monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    monkeypatch.setattr("appliance.network.scan.socket.socket", Stuck)
    monkeypatch.setattr(Stuck, "number", number)
    with pytest.raises(NetworkError, match=f"192.0.2.7 port 1: {os.strerror(number)}"):
        scan("192.0.2.7", [1, 2, 3], seconds=10)


@pytest.mark.nightly
def test_a_machine_without_a_family_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def none_of_it(*_arguments: object) -> socket.socket:
        raise OSError(errno.EAFNOSUPPORT, os.strerror(errno.EAFNOSUPPORT))

    monkeypatch.setattr("appliance.network.scan.socket.socket", none_of_it)
    with pytest.raises(NetworkError, match=r"2001:db8::7.*Address family not supported"):
        scan("2001:db8::7", [1], seconds=10)
    assert addresses_of("2001:db8::7") == ("2001:db8::7",)


@pytest.mark.nightly
def test_a_link_local_address_without_a_zone_is_an_error() -> None:
    """The kernel cannot use a link-local address without its interface."""
    if not Path("/proc/sys/net/ipv6").exists():
        pytest.skip("no IPv6 here")
    with pytest.raises(NetworkError, match="fe80::1 port 9"):
        scan("fe80::1", [9], seconds=10)


class OneThread:
    def __init__(self, _most: int, _name: str) -> None:
        self.map = map

    def shutdown(self, *, cancel_futures: bool) -> None:
        assert cancel_futures


@pytest.mark.parametrize(
    ("answers", "expected"),
    [
        ({1: [REFUSED], 2: [SILENT, OPEN], 3: [SILENT, REFUSED], 4: [SILENT, SILENT]}, ((2,), 2, 1)),
        ({1: [OPEN], 2: [SILENT, SILENT]}, ((1,), 0, 1)),
        ({1: [SILENT], 2: [SILENT]}, ((), 0, 2)),  # a silent machine is not tried twice
    ],
)
def test_a_lost_packet_does_not_make_a_port_closed(
    monkeypatch: pytest.MonkeyPatch, answers: dict[int, list[int]], expected: tuple[tuple[int, ...], int, int]
) -> None:
    monkeypatch.setattr("appliance.network.scan.ThreadPoolExecutor", OneThread)
    monkeypatch.setattr(
        "appliance.network.scan._try", lambda _address, port, _seconds: (True, answers[port].pop(0))
    )
    result = scan("192.0.2.7", list(answers), seconds=10)
    assert (result.open, result.refused, result.silent) == expected
    assert not any(answers.values())


@pytest.mark.nightly
def test_a_scan_of_no_ports_ends() -> None:
    assert not scan("127.0.0.1", [], seconds=10).answered


@pytest.mark.nightly
def test_the_machine_itself_is_not_another() -> None:
    for address in ("127.0.0.1", "::1", "localhost"):
        with pytest.raises(NetworkError, match="is this machine"):
            addresses_of(address)
