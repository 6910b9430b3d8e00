"""Tests of `appliance.supervisor.isolation_lifecycle` on a host of the lab: the real kernel, the real firewall."""

import os
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from appliance.network.firewall.firewall import FirewallReport
from appliance.network.firewall.firewall_rules import PortRange
from appliance.network.isolation import Isolation, IsolationSettings
from appliance.network.namespaces import NetworkError
from appliance.supervisor.isolation_lifecycle import Contained, InNamespace, Ports
from examples.landshark.lab import Host, Lab
from tests.support.requirements import need_program, need_root
from tests.support.translators import TRANSLATORS, load

NODES = range(19001, 19101)
OWN_NODE = range(18000, 18064)


@pytest.fixture
def host() -> Iterator[Host]:
    """A host of its own."""
    need_root()
    need_program("nft", "nftables")
    with Lab("rosrv-enclosure") as lab:
        yield lab.host("appliance", "10.79.0.2/24")


@pytest.fixture
def hidden(host: Host) -> Iterator[int]:
    """The port of something that listens on the host's loopback."""
    with host.run(lambda: socket.create_server(("127.0.0.1", 0))) as listener:
        yield listener.getsockname()[1]


@pytest.fixture
def enclosure(host: Host, hidden: int) -> Iterator[Contained]:
    """The surroundings of an appliance whose ROSMaster is the hidden port."""
    made = Contained(
        Ports(master=11311, rosmaster=hidden, nodes=NODES, own_node=OWN_NODE), "auto", host.namespace
    )
    yield made
    made.remove()


def reachable(host: Host, port: int) -> bool:
    """Whether root of the host gets through to a port."""

    def connect() -> bool:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=5).close()
        except ConnectionRefusedError:
            return False
        return True

    return host.run(connect)


def test_what_is_enclosed_is_hidden_until_the_end(host: Host, enclosure: Contained, hidden: int) -> None:
    """Open before, closed while the enclosure stands (root included), open afterwards; the probe agrees."""
    assert "can be reached" in str(enclosure.probe())
    assert reachable(host, hidden)
    enclosure.build()
    assert enclosure.probe() is None
    assert not reachable(host, hidden)
    enclosure.remove()
    assert reachable(host, hidden)


def test_the_inner_face_is_closed_once_it_is_known(host: Host, enclosure: Contained) -> None:
    """Control's inner face is open to everybody until control says where it is, then to rosmaster only."""
    enclosure.build()
    with host.run(lambda: socket.create_server(("127.0.0.1", 0))) as inner:
        port = inner.getsockname()[1]
        assert reachable(host, port)
        enclosure.control_ready(port, port + 1)
        assert not reachable(host, port)
        assert enclosure.probe() is None


def test_rules_that_were_refused_are_owed(
    host: Host, enclosure: Contained, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A new inner face that could not be closed is closed by the next look; its failure was an error."""
    enclosure.build()
    firewall = enclosure.firewall
    assert firewall is not None

    def refused(_settings: object) -> None:
        raise NetworkError("the kernel says no")

    with host.run(lambda: socket.create_server(("127.0.0.1", 0))) as inner:
        port = inner.getsockname()[1]
        with monkeypatch.context() as patch, pytest.raises(NetworkError, match="says no"):
            patch.setattr(firewall, "update", refused)
            enclosure.control_ready(port, port + 1)
        assert reachable(host, port)
        assert all(rule.in_force for rule in enclosure.report().rules or ())
        assert not reachable(host, port)


def test_rules_that_are_taken_away_come_back(host: Host, enclosure: Contained, hidden: int) -> None:
    """Somebody flushes the rules: the next look puts them back, and they are reported in force."""
    enclosure.build()
    backend = enclosure.report().backend
    flush = ["nft", "flush", "ruleset"] if backend == "nft" else ["iptables", "-F"]
    assert host.popen(flush).wait() == 0
    assert reachable(host, hidden)
    report = enclosure.report()
    assert all(rule.in_force for rule in report.rules or ())
    assert not reachable(host, hidden)


def test_what_is_taken_away_stays_away(
    host: Host, enclosure: Contained, hidden: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A look that is still under way at the end, or comes after it, puts nothing back: the end waits for it."""
    enclosure.build()
    firewall = enclosure.firewall
    assert firewall is not None
    looking, go_on = threading.Event(), threading.Event()
    report = firewall.report

    def slowly() -> FirewallReport:
        looking.set()
        assert go_on.wait(30)
        return replace(
            report(), rules=(), backend=None
        )  # as somebody sees it whose rules were just taken away

    monkeypatch.setattr(firewall, "report", slowly)
    with ThreadPoolExecutor() as pool:
        look = pool.submit(enclosure.report)
        assert looking.wait(30)
        end = pool.submit(enclosure.remove)
        with pytest.raises(TimeoutError):
            end.result(0.2)
        go_on.set()
        end.result(30)
        with pytest.raises(NetworkError, match="the appliance ends"):
            look.result(30)
    assert reachable(host, hidden)
    for late in (enclosure.report, lambda: enclosure.control_ready(1, 2)):
        with pytest.raises(NetworkError, match="the appliance ends"):
            late()
    assert reachable(host, hidden)


def test_an_end_does_not_wait_for_a_look_that_hangs(
    host: Host, enclosure: Contained, hidden: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rules are taken away all the same, and the look puts nothing back when it wakes up."""
    monkeypatch.setattr("appliance.supervisor.isolation_lifecycle._PATIENCE_SECONDS", 0.1)
    enclosure.build()
    firewall = enclosure.firewall
    assert firewall is not None
    looking, go_on = threading.Event(), threading.Event()
    report = firewall.report

    def hanging() -> FirewallReport:
        looking.set()
        assert go_on.wait(30)
        return report()

    monkeypatch.setattr(firewall, "report", hanging)
    with ThreadPoolExecutor() as pool:
        look = pool.submit(enclosure.report)
        assert looking.wait(30)
        enclosure.remove()
        go_on.set()
        with pytest.raises(NetworkError, match="the appliance ends"):
            look.result(30)
    assert reachable(host, hidden)


def test_rules_on_the_host_come_back(host: Host, tmp_path: Path) -> None:
    """A bare host's firewall is loaded anew, the appliance's way in with it: the next look puts that back."""
    forwarded = IsolationSettings(
        ports=(PortRange.one(11311),), name=f"renc{os.getpid()}", directory=tmp_path
    )
    ports = Ports(master=11311, rosmaster=11411, nodes=NODES, own_node=OWN_NODE)
    enclosure = InNamespace(ports, "auto", Isolation(host.namespace, forwarded))
    enclosure.build()
    try:
        assert host.popen(["nft", "flush", "ruleset"]).wait() == 0
        report = enclosure.report()
        assert report.forwarding
        assert all(rule.in_force for rule in [*report.forwarding, *(report.rules or ())])
    finally:
        enclosure.remove()


def test_what_others_do_to_forwarded_packets_is_said(host: Host, tmp_path: Path) -> None:
    """Docker's rules on the host are in the report; the namespace takes only the machine's own packets for its."""
    need_program("iptables-legacy-restore", "iptables")
    load(host.namespace, TRANSLATORS[0].form, TRANSLATORS[0].rules)
    forwarded = IsolationSettings(
        ports=(PortRange.one(11311),), name=f"rend{os.getpid()}", directory=tmp_path
    )
    ports = Ports(master=11311, rosmaster=11411, nodes=NODES, own_node=OWN_NODE)
    isolation = Isolation(host.namespace, forwarded)
    enclosure = InNamespace(ports, "auto", isolation)
    enclosure.build()
    try:
        report = enclosure.report()
        assert report.translations == [TRANSLATORS[0].chain]
        (obstacle,) = report.obstacles or [""]
        assert "iptables-legacy chain filter FORWARD" in obstacle
        own = f"{isolation.ends[4].host}: the machine's own packets only"
        assert [rule.in_force for rule in report.rules or () if rule.purpose == own] == [True]
    finally:
        enclosure.remove()


def test_what_listens_on_more_than_loopback_is_not_hidden(host: Host, enclosure: Contained) -> None:
    """A port on every address is a finding, even while the firewall keeps others out."""
    enclosure.build()
    with host.run(lambda: socket.create_server(("0.0.0.0", 0))) as listener:
        enclosure.control_ready(listener.getsockname()[1], 1)
        assert "not on loopback only" in str(enclosure.probe())
