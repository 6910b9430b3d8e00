"""Real tunnels between namespaces: two charons, real nodes on both sides, and a policy that trusts only the tunnel.

The hosts are `robot` in clear text, `ocu` behind a tunnel as `host:ocu-1`, and `attacker` on the same Ethernet.
"""

import json
import re
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.ipsec.certificate_authority import CertificateAuthority
from appliance.ipsec.requests import make_key, signing_request
from appliance.network import interfaces
from examples.landshark.lab import INTERFACE, Lab
from tests.support.nodes import RosSession
from tests.support.processes import Event
from tests.support.requirements import need_root
from tests.support.tunnel_site import ATTACKER, LONG, MASTER, MIDDLE, OCU, OWN, TunnelSite
from tests.support.tunnels import JoinedHost, need_strongswan
from tests.support.waiting import allowed


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TunnelSite]:
    need_root()
    need_strongswan()
    with Lab("rosrv-ipsec") as lab, TunnelSite(lab, tmp_path_factory.mktemp("ipsec")) as one:
        yield one


@pytest.fixture(scope="module")
def kit(site: TunnelSite) -> Path:
    return site.kit()


@pytest.fixture
def joined(site: TunnelSite, kit: Path) -> Iterator[JoinedHost]:
    with site.joined(kit) as host:
        yield host


def test_without_a_host_there_is_no_tunnel(site: TunnelSite) -> None:
    status = site.appliance.status()
    assert "charon" not in [row["role"] for row in status["processes"]]
    assert status["ipsec"]["esp"] is None
    assert status["policy"]["warnings"] > 0


@pytest.mark.real
def test_nodes_talk_through_the_tunnel(site: TunnelSite, joined: JoinedHost) -> None:
    assert joined.master == f"http://{OWN}:11311"
    with (
        RosSession(MASTER, site.home, site.robot) as on_robot,
        RosSession(joined.master, site.home, joined) as on_ocu,
    ):
        on_robot.talker("rospy", "/chatter", name="voice")
        on_ocu.talker("roscpp", "/orders", name="boss")
        on_ocu.listener("roscpp", "/chatter", name="ear").wait_for(event="received")
        on_robot.listener("rospy", "/orders", name="arm").wait_for(event="received")
        assert "/boss" in on_ocu.run("/usr/bin/rosnode", "list").stdout
    hosts = {
        record["host"]
        for record in site.appliance.audit(event="registered")
        if record["caller_id"] == "/boss"
    }
    assert hosts == {joined.address}
    status = site.appliance.status()
    assert status["ipsec"]["up"] == 1
    assert [row["role"] for row in status["processes"]].count("charon") == 1
    (row,) = map(json.loads, site.appliance.rosrv("host", "list", "--json").stdout.splitlines())
    assert (row["name"], row["address"], row["state"], row["remote"]) == ("ocu-1", joined.address, "up", OCU)


@pytest.mark.real
def test_a_blocked_host_has_no_tunnel_until_it_is_unblocked(site: TunnelSite, joined: JoinedHost) -> None:
    with site.talking(joined) as (_talker, listener):
        said = site.appliance.rosrv("host", "block", OCU).stdout
        assert f"the tunnel of ocu-1, from {OCU}" in said
        site.is_down()
        site.appliance.rosrv("host", "unblock", OCU)
        listener.wait_for(event="received", since=listener.mark())
        said = site.appliance.rosrv("host", "block", "ocu-1").stdout
        assert said.startswith(
            f"ocu-1 ({joined.address}) is blocked until `rosrv host unblock {joined.address}`; "
        )
        assert "which is not blocked" not in said
        with RosSession(joined.master, site.home, joined) as there:
            assert there.run("rostopic", "list", check=False).returncode != 0
        site.is_down()
        quiet = listener.mark()
        assert not [event for event in listener.events[quiet:] if event.get("event") == "received"]
        site.appliance.rosrv("host", "unblock", "ocu-1")
        listener.wait_for(event="received", since=listener.mark())


def test_a_forged_address_gets_nowhere(site: TunnelSite, kit: Path) -> None:
    forged = "10.113.11.2"
    interfaces.add_address(site.attacker.namespace, INTERFACE, f"{forged}/32")
    interfaces.add_route(site.attacker.namespace, f"{OWN}/32", MIDDLE)

    def connect(source: str, target: str) -> str:
        def work() -> str:
            with socket.socket() as client:
                client.settimeout(3)
                client.bind((source, 0))
                try:
                    client.connect((target, 11311))
                except TimeoutError:
                    return "nothing"
                return "connected"

        return site.attacker.run(work)

    assert connect(ATTACKER, MIDDLE) == "connected", "the way there is open for the attacker's own address"
    assert connect(forged, MIDDLE) == "nothing"
    assert connect(forged, OWN) == "nothing"
    rules = site.appliance.status()["firewall"]["rules"]
    assert any(rule["purpose"].endswith("through its tunnel only") for rule in rules)


def test_a_foreign_certificate_is_refused(site: TunnelSite, kit: Path) -> None:
    site.home.joinpath("foreign").mkdir()
    foreign, key = CertificateAuthority(site.home / "foreign"), make_key()
    thief = site.join(kit, site.attacker)
    made = foreign.issue(signing_request(key, "ocu-1"), "ocu-1", 90)
    (thief.folder / "swanctl/x509/rosrv.pem").write_bytes(made.certificate)
    (thief.folder / "swanctl/private/rosrv.key").write_bytes(key)
    mark = site.mark
    with thief:
        thief.wait_until_refused()
        refused = site.refused(mark, ATTACKER)
    assert "no issuer certificate found" in refused["reason"]
    assert refused["decision"] == "deny"


def test_an_interrupted_tunnel_recovers(site: TunnelSite, joined: JoinedHost) -> None:
    with (
        RosSession(MASTER, site.home, site.robot) as on_robot,
        RosSession(joined.master, site.home, joined) as on_ocu,
    ):
        on_robot.talker("rospy", "/chatter", name="voice")
        listener = on_ocu.listener("roscpp", "/chatter", name="ear")
        listener.wait_for(event="received")
        mark = site.mark
        site.lab.unplug(site.ocu)
        site.recorded(mark, event="tunnel down")
        assert site.state() == "down"
        mark = site.mark
        site.lab.plug(site.ocu)
        site.recorded(mark, event="tunnel up")
        listener.wait_for(event="received", since=len(listener.events), timeout=LONG)


def test_a_dead_charon_is_restarted(site: TunnelSite, joined: JoinedHost) -> None:
    mark = site.mark
    before = site.appliance.kill("charon")
    site.recorded(mark, event="tunnel down")
    site.recorded(mark, event="tunnel up")
    assert site.appliance.pids("charon") != [before]
    site.is_up()


def test_a_replaced_certificate_is_revoked(site: TunnelSite, kit: Path, joined: JoinedHost) -> None:
    mark = site.mark
    new = site.kit("kit")
    site.recorded(mark, event="tunnel down")
    refused = site.refused(mark)
    assert refused["host"] == OCU
    assert "revoked" in refused["reason"]
    joined.stop()
    with site.join(new) as again:
        again.wait_until_up()
        site.recorded(mark, event="tunnel up")
        assert again.address == joined.address
        revoke_while_it_talks(site, again)


def revoke_while_it_talks(site: TunnelSite, joined: JoinedHost) -> None:
    with (
        RosSession(MASTER, site.home, site.robot) as on_robot,
        RosSession(joined.master, site.home, joined) as on_ocu,
    ):
        talker = on_ocu.talker("rospy", "/orders", "--rate", "50", name="boss")
        listener = on_robot.listener("roscpp", "/orders", name="arm")
        listener.wait_for(event="received")
        mark = site.mark
        site.appliance.rosrv("host", "revoke", "ocu-1")
        revoked = site.recorded(mark, event="host revoked")
        closed = site.recorded(mark, event="connection closed")
        down = site.recorded(mark, event="tunnel down")
        assert revoked["detail"]["taken_back"] >= 1
        moments = [_seconds(record) for record in (revoked, closed, down)]
        assert max(moments) - moments[0] < allowed(1.0)
        assert "/orders" not in on_robot.run("/usr/bin/rostopic", "list", "-p").stdout
        refused = site.refused(mark, OCU)
        assert refused["decision"] == "deny"
        assert site.state() == "revoked"
        talker.kill()  # it cannot close the tunnel with a message


def _seconds(record: Event) -> float:
    hours, minutes, seconds = str(record["time"]).split("T")[1].rstrip("Z").split(":")
    return int(hours) * 3600 + int(minutes) * 60 + float(seconds)


def test_the_shell_accepts_the_scripts_of_a_kit(site: TunnelSite, kit: Path) -> None:
    assert kit.stat().st_mode & 0o777 == 0o600
    folder = site.join(kit).folder
    for script in ("join.sh", "leave.sh", "keep.sh"):
        subprocess.run(["/bin/sh", "-n", str(folder / script)], check=True)
        assert not re.search("@[a-z]+@", (folder / script).read_text())
