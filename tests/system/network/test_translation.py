import os
import socket
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from appliance.network import interfaces
from appliance.network.firewall.firewall import BackendChoice, Firewall
from appliance.network.firewall.firewall_rules import FirewallSettings
from appliance.network.firewall.nft import NftBackend
from appliance.network.namespaces import Namespace
from examples.landshark.lab import Host, Lab
from tests.support.docker import Engine
from tests.support.forged_syns import ETH_P_ALL, send_syn, syn_sources
from tests.support.requirements import need_program, need_root
from tests.support.translators import TRANSLATORS, Translator, guest_behind, load, plugged
from tests.system.network.test_isolation import isolated, serving, source_seen

MASTER = 11311
DOCKER = TRANSLATORS[0]


@pytest.fixture
def lab() -> Iterator[Lab]:
    need_root()
    for program, package in (("nft", "nftables"), ("iptables-legacy", "iptables")):
        need_program(program, package)
    with Lab("rosrv-nat") as one:
        one.host("machine", "10.77.0.2/24", "fd77::2/64")
        yield one


@pytest.fixture
def machine(lab: Lab) -> Host:
    return lab.hosts["machine"]


@pytest.fixture
def behind(lab: Lab) -> Namespace:
    host = lab.host("guest", "10.76.0.2/24")
    interfaces.delete_link(host.namespace, "eth0")
    return host.namespace


@pytest.mark.parametrize("translator", TRANSLATORS, ids=lambda one: one.name)
def test_a_guest_keeps_its_address(
    machine: Host, behind: Namespace, tmp_path: Path, translator: Translator
) -> None:
    guest = guest_behind(machine.namespace, behind, translator)
    with isolated(machine, tmp_path) as isolation, serving(isolation.namespace, MASTER) as server:
        for address in (f"{translator.network}.1", machine.address):
            assert source_seen(server, guest, address, MASTER) == guest.address
        assert source_seen(server, guest, machine.address6, MASTER) == guest.address6
        own = isolation.ends[4]
        assert source_seen(server, machine, "127.0.0.1", MASTER) == own.host
        assert source_seen(server, machine, own.appliance, MASTER) == own.host
        assert source_seen(server, machine, machine.address, MASTER) == machine.address
        with guest.entered(), pytest.raises(OSError, match=r"timed out|refused|unreachable|prohibited"):
            socket.create_connection((own.appliance, MASTER), timeout=1)
        assert translator.chain in isolation.translations()


@pytest.mark.parametrize("legacy", [False, True], ids=["iptables-nft", "iptables-legacy"])
def test_a_guest_of_the_real_docker_keeps_its_address(
    machine: Host, behind: Namespace, tmp_path: Path, legacy: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if legacy:
        for program in ("iptables", "ip6tables"):
            (tmp_path / program).symlink_to(need_program(f"{program}-legacy", "iptables"))
        monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    with Engine(machine, data=tmp_path / "docker"), isolated(machine, tmp_path) as isolation:
        guest = plugged(machine.namespace, behind, "docker0", "172.17.0")
        assert any("FORWARD drops" in text for text in isolation.obstacles())
        for way in ("-i", "-o"):
            line = f"iptables -I DOCKER-USER {way} {isolation.settings.link} -j ACCEPT"
            assert machine.popen(line.split()).wait(timeout=20) == 0
        with serving(isolation.namespace, MASTER) as server:
            assert source_seen(server, guest, "172.17.0.1", MASTER) == guest.address
            assert source_seen(server, guest, machine.address, MASTER) == guest.address
            assert source_seen(server, machine, "127.0.0.1", MASTER) == isolation.ends[4].host
            assert source_seen(server, machine, machine.address, MASTER) == machine.address
        kind = "iptables-legacy chain nat" if legacy else "nftables chain ip nat"
        assert f"{kind} POSTROUTING" in isolation.translations()


def test_an_earlier_chain_cannot_give_a_guest_the_machines_address(
    machine: Host, behind: Namespace, tmp_path: Path
) -> None:
    guest = guest_behind(machine.namespace, behind, DOCKER)
    early = "table ip early {{ chain first {{ type nat hook postrouting priority -199; ip saddr {} masquerade; }}\n}}\n"
    with isolated(machine, tmp_path) as isolation, serving(isolation.namespace, MASTER) as server:
        load(machine.namespace, "nft", early.format(guest.address))
        with guest.entered(), pytest.raises(TimeoutError):
            socket.create_connection((machine.address, MASTER), timeout=1)
        (guard,) = (rule for rule in isolation.rules() if "with an address of the host" in rule.purpose)
        assert guard.packets > 0
        assert source_seen(server, machine, "127.0.0.1", MASTER) == isolation.ends[4].host


@pytest.mark.parametrize("backend", ["nft", "iptables"])
def test_without_rules_the_machines_own_packets_are_recognized(
    machine: Host, behind: Namespace, tmp_path: Path, backend: BackendChoice
) -> None:
    guest = guest_behind(machine.namespace, behind, DOCKER)
    with isolated(machine, tmp_path) as isolation, serving(isolation.namespace, MASTER) as server:
        own = isolation.ends[4]
        NftBackend(machine.namespace).remove()
        assert source_seen(server, guest, own.appliance, MASTER) == own.host, "the attack is possible"
        firewall = Firewall(isolation.namespace, backend)
        neighbours = tuple(ends.host for ends in isolation.ends.values())
        firewall.install(
            FirewallSettings(control_uid=1, rosmaster_uid=2, master_port=MASTER, neighbours=neighbours)
        )
        for hops in (64, 255):
            with guest.entered(), socket.socket() as client:
                client.setsockopt(socket.IPPROTO_IP, socket.IP_TTL, hops)
                client.settimeout(1)
                with pytest.raises(TimeoutError):
                    client.connect((own.appliance, MASTER))
        assert source_seen(server, machine, own.appliance, MASTER) == own.host
        assert source_seen(server, machine, isolation.ends[6].appliance, MASTER) == isolation.ends[6].host
        isolation.put_rules_back()
        assert source_seen(server, machine, "127.0.0.1", MASTER) == own.host
        assert source_seen(server, guest, machine.address, MASTER) == guest.address
        assert next(rule for rule in firewall.report().rules if "own packets" in rule.purpose).packets > 1


def test_forged_source_addresses_do_not_arrive(machine: Host, behind: Namespace, tmp_path: Path) -> None:
    guest = guest_behind(machine.namespace, behind, DOCKER)
    with isolated(machine, tmp_path) as isolation, serving(isolation.namespace, MASTER) as server:
        with isolation.namespace.inside():
            wire = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(ETH_P_ALL))
        with wire:
            for family in (4, 6):
                ends = isolation.ends[family]
                loopback, targets = (
                    ("127.0.0.1", (machine.address, f"{DOCKER.network}.1", ends.appliance))
                    if family == 4
                    else ("::1", (machine.address6, "fd88::1", ends.appliance))
                )
                for source in (ends.host, ends.appliance, loopback):
                    for target in targets:
                        guest.run(partial(send_syn, source, target, MASTER))
            assert source_seen(server, guest, machine.address, MASTER) == guest.address
            arrived = syn_sources(wire)
        assert arrived == [guest.address]
