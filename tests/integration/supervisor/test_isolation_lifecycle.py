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
from appliance.supervisor.isolation_lifecycle import AppliancePorts, ContainerIsolation, NetnsIsolation
from examples.landshark.lab import Host, Lab
from tests.support.processes import LIMIT
from tests.support.requirements import need_program, need_root
from tests.support.translators import TRANSLATORS, load

NODES = range(19001, 19101)
OWN_NODE = range(18000, 18064)


@pytest.fixture
def host() -> Iterator[Host]:
    need_root()
    need_program("nft", "nftables")
    with Lab("rosrv-enclosure") as lab:
        yield lab.host("appliance", "10.79.0.2/24")


@pytest.fixture
def hidden(host: Host) -> Iterator[int]:
    with host.run(lambda: socket.create_server(("127.0.0.1", 0))) as listener:
        yield listener.getsockname()[1]


@pytest.fixture
def isolation(host: Host, hidden: int) -> Iterator[ContainerIsolation]:
    made = ContainerIsolation(
        AppliancePorts(master=11311, rosmaster=hidden, nodes=NODES, own_node=OWN_NODE), "auto", host.namespace
    )
    yield made
    made.remove()


def reachable(host: Host, port: int) -> bool:
    def connect() -> bool:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=5).close()
        except ConnectionRefusedError:
            return False
        return True

    return host.run(connect)


def test_an_isolated_port_is_hidden_until_the_end(
    host: Host, isolation: ContainerIsolation, hidden: int
) -> None:
    assert "can be reached" in str(isolation.probe())
    assert reachable(host, hidden)
    isolation.build()
    assert isolation.probe() is None
    assert not reachable(host, hidden)
    isolation.remove()
    assert reachable(host, hidden)


def test_the_master_side_endpoint_is_closed_once_it_is_known(
    host: Host, isolation: ContainerIsolation
) -> None:
    isolation.build()
    with host.run(lambda: socket.create_server(("127.0.0.1", 0))) as inner:
        port = inner.getsockname()[1]
        assert reachable(host, port)
        isolation.control_ready(port, port + 1)
        assert not reachable(host, port)
        assert isolation.probe() is None


def test_failed_rules_are_retried(
    host: Host, isolation: ContainerIsolation, monkeypatch: pytest.MonkeyPatch
) -> None:
    isolation.build()
    firewall = isolation.firewall
    assert firewall is not None

    def refused(_settings: object) -> None:
        raise NetworkError("the kernel says no")

    with host.run(lambda: socket.create_server(("127.0.0.1", 0))) as inner:
        port = inner.getsockname()[1]
        with monkeypatch.context() as patch, pytest.raises(NetworkError, match="says no"):
            patch.setattr(firewall, "update", refused)
            isolation.control_ready(port, port + 1)
        assert reachable(host, port)
        assert all(rule.in_force for rule in isolation.report().rules or ())
        assert not reachable(host, port)


def test_removed_rules_are_restored(host: Host, isolation: ContainerIsolation, hidden: int) -> None:
    isolation.build()
    backend = isolation.report().backend
    flush = ["nft", "flush", "ruleset"] if backend == "nft" else ["iptables", "-F"]
    assert host.popen(flush).wait() == 0
    assert reachable(host, hidden)
    report = isolation.report()
    assert all(rule.in_force for rule in report.rules or ())
    assert not reachable(host, hidden)


def test_a_check_does_not_restore_rules_after_the_end(
    host: Host, isolation: ContainerIsolation, hidden: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    isolation.build()
    firewall = isolation.firewall
    assert firewall is not None
    looking, go_on = threading.Event(), threading.Event()
    report = firewall.report

    def slowly() -> FirewallReport:
        looking.set()
        assert go_on.wait(LIMIT)
        return replace(
            report(), rules=(), backend=None
        )  # as another program sees the firewall right after the removal of its rules

    monkeypatch.setattr(firewall, "report", slowly)
    with ThreadPoolExecutor() as pool:
        look = pool.submit(isolation.report)
        assert looking.wait(LIMIT)
        end = pool.submit(isolation.remove)
        with pytest.raises(TimeoutError):
            end.result(0.2)
        go_on.set()
        end.result(30)
        with pytest.raises(NetworkError, match="the appliance stops"):
            look.result(30)
    assert reachable(host, hidden)
    for late in (isolation.report, lambda: isolation.control_ready(1, 2)):
        with pytest.raises(NetworkError, match="the appliance stops"):
            late()
    assert reachable(host, hidden)


def test_the_end_does_not_wait_for_a_hanging_check(
    host: Host, isolation: ContainerIsolation, hidden: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("appliance.supervisor.isolation_lifecycle._PATIENCE_SECONDS", 0.1)
    isolation.build()
    firewall = isolation.firewall
    assert firewall is not None
    looking, go_on = threading.Event(), threading.Event()
    report = firewall.report

    def hanging() -> FirewallReport:
        looking.set()
        assert go_on.wait(LIMIT)
        return report()

    monkeypatch.setattr(firewall, "report", hanging)
    with ThreadPoolExecutor() as pool:
        look = pool.submit(isolation.report)
        assert looking.wait(LIMIT)
        isolation.remove()
        go_on.set()
        with pytest.raises(NetworkError, match="the appliance stops"):
            look.result(30)
    assert reachable(host, hidden)


def test_rules_on_the_host_are_restored(host: Host, tmp_path: Path) -> None:
    forwarded = IsolationSettings(
        ports=(PortRange.one(11311),), name=f"renc{os.getpid()}", directory=tmp_path
    )
    ports = AppliancePorts(master=11311, rosmaster=11411, nodes=NODES, own_node=OWN_NODE)
    isolation = NetnsIsolation(ports, "auto", Isolation(host.namespace, forwarded))
    isolation.build()
    try:
        assert host.popen(["nft", "flush", "ruleset"]).wait() == 0
        report = isolation.report()
        assert report.forwarding
        assert all(rule.in_force for rule in [*report.forwarding, *(report.rules or ())])
        assert "forwarded ports" in isolation.restore().rules, "it is recorded once"
        assert isolation.restore().rules == []
    finally:
        isolation.remove()


def test_rules_of_other_programs_for_forwarding_are_reported(host: Host, tmp_path: Path) -> None:
    need_program("iptables-legacy-restore", "iptables")
    load(host.namespace, TRANSLATORS[0].form, TRANSLATORS[0].rules)
    forwarded = IsolationSettings(
        ports=(PortRange.one(11311),), name=f"rend{os.getpid()}", directory=tmp_path
    )
    ports = AppliancePorts(master=11311, rosmaster=11411, nodes=NODES, own_node=OWN_NODE)
    link = Isolation(host.namespace, forwarded)
    isolation = NetnsIsolation(ports, "auto", link)
    isolation.build()
    try:
        report = isolation.report()
        assert report.translations == [TRANSLATORS[0].chain]
        (obstacle,) = report.obstacles or [""]
        assert "iptables-legacy chain filter FORWARD" in obstacle
        own = f"{link.ends[4].host}: the machine's own packets only"
        assert [rule.in_force for rule in report.rules or () if rule.purpose == own] == [True]
    finally:
        isolation.remove()


def test_a_listener_beyond_loopback_is_not_hidden(host: Host, isolation: ContainerIsolation) -> None:
    isolation.build()
    with host.run(lambda: socket.create_server(("0.0.0.0", 0))) as listener:
        isolation.control_ready(listener.getsockname()[1], 1)
        assert "not on loopback only" in str(isolation.probe())
