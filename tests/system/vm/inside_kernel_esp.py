import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.network import interfaces
from examples.landshark.lab import INTERFACE, Host, Lab
from tests.support.nodes import RosSession
from tests.support.processes import LIMIT
from tests.support.tunnel_site import ATTACKER, LONG, MIDDLE, OCU, OWN, TunnelSite, left_behind
from tests.support.tunnels import JoinedHost
from tests.support.wire import connect
from tests.system.ipsec import test_attacks as attacks

# The same attacks as on ESP in user space, collected here with this module's appliance.
kit, other, others_kit, datagrams = attacks.kit, attacks.other, attacks.others_kit, attacks.datagrams
test_replayed_packets_are_refused = attacks.test_replayed_packets_are_refused
test_a_host_cannot_send_as_another = attacks.test_a_host_in_a_tunnel_cannot_send_as_another
test_a_local_program_is_no_host = attacks.test_a_local_program_is_not_a_tunnelled_host


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TunnelSite]:
    home = tmp_path_factory.mktemp("site")
    with Lab("rosrv-kernel") as lab, TunnelSite(lab, home, options=("--api", "off")) as one:
        yield one
        stop_and_look(one)


@pytest.fixture
def joined(site: TunnelSite, kit: Path) -> Iterator[JoinedHost]:
    with site.joined(kit) as host:
        yield host


def middle(site: TunnelSite) -> Host:
    assert isinstance(site.appliance.host, Host)
    return site.appliance.host


def told(host: Host, *command: str) -> str:
    process = host.popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    return str(process.communicate(timeout=LIMIT)[0])


def test_esp_is_the_kernels(site: TunnelSite, joined: JoinedHost) -> None:
    status = site.appliance.status()
    assert status["ipsec"]["esp"] == "kernel"
    assert status["ipsec"]["up"] == 1
    states = told(middle(site), "ip", "xfrm", "state")
    assert states.count("rfc4106(gcm(aes))") == 2
    assert interfaces.links(middle(site).namespace).count("ipsec0") == 0
    assert status["firewall"]["backend"] == "nft"
    rules = told(middle(site), "nft", "list", "ruleset")
    assert "ip saddr 10.113.11.0/24 meta ipsec missing" in rules
    assert "ip daddr 10.113.11.0/24 rt ipsec missing" in rules


def test_a_node_publishes_through_the_kernel(site: TunnelSite, joined: JoinedHost) -> None:
    with site.talking(joined, rate=20) as (_talker, listener):
        listener.wait_for_count(20, event="received", timeout=LONG)
    registered = site.trail.wait_for(event="registered", caller_id="/boss", timeout=LONG)
    assert registered["host"] == joined.address
    used = re.findall(r"(\d+)\(bytes\)", told(middle(site), "ip", "-s", "xfrm", "state"))
    assert max(map(int, used)) > 1000, used


def test_a_forged_address_gets_nowhere(site: TunnelSite, joined: JoinedHost) -> None:
    interfaces.add_route(site.attacker.namespace, f"{OWN}/32", MIDDLE)
    for forged in (joined.address, "10.113.11.77"):
        interfaces.add_address(site.attacker.namespace, INTERFACE, f"{forged}/32")
        assert connect(site.attacker, forged, MIDDLE) == "nothing"
        assert connect(site.attacker, forged, OWN) == "nothing"
    assert connect(site.attacker, ATTACKER, MIDDLE) == "connected", "the destination is reachable"
    assert connect(site.ocu, joined.address, OWN) == "connected", "through the tunnel"
    assert connect(site.ocu, OCU, MIDDLE) == "connected"


def test_charon_that_dies_leaves_nothing_behind(site: TunnelSite, joined: JoinedHost) -> None:
    assert joined.charon is not None
    mark, before = joined.charon.mark(), set(_spis(middle(site)))
    site.appliance.kill("charon")
    joined.wait_until_up(since=mark)
    after = _spis(middle(site))
    assert len(after) == 2
    assert not before & set(after)
    with RosSession(joined.master, site.home, joined) as ros:
        assert "/rosout" in ros.run("/usr/bin/rosnode", "list", timeout=LONG).stdout


def _spis(host: Host) -> list[str]:
    return [line.split()[3] for line in told(host, "ip", "xfrm", "state").splitlines() if "proto esp" in line]


def stop_and_look(site: TunnelSite) -> None:
    assert site.appliance.stop() == 0
    assert left_behind(middle(site)) == {}
