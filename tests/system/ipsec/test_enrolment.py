"""A host enrols with a one-time token, using the kit's own scripts: join, renew, leave.

The laptop is a network namespace without systemd. Before the tunnel is up, REST is reached from the management
network.
"""

import contextlib
import datetime
import json
import os
import re
import signal
import socket
import subprocess
import tarfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.ipsec.requests import make_key, signing_request
from appliance.network import interfaces
from examples.landshark.lab import Lab
from tests.support.command import ROSRV
from tests.support.nodes import RosSession
from tests.support.processes import LIMIT
from tests.support.requirements import need_program, need_root
from tests.support.script_host import ScriptHost
from tests.support.tunnel_site import API, ATTACKER, LONG, MASTER, MIDDLE, OCU, OWN, POLICY, TunnelSite
from tests.support.tunnels import need_strongswan
from tests.support.waiting import allowed, eventually
from tests.support.wire import connect

CONFIG = f"""\
api: 0.0.0.0:{API}
api_networks: [10.88.0.0/24]
api_names: [{MIDDLE}]
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TunnelSite]:
    need_root()
    need_strongswan()
    for program, package in (("nft", "nftables"), ("curl", "curl"), ("openssl", "openssl")):
        need_program(program, package)
    home = tmp_path_factory.mktemp("enrolment")
    (home / "appliance.yaml").write_text(CONFIG)
    with Lab("rosrv-enrol") as lab:
        policy = POLICY.replace("host:ocu-1", "host:laptop host:other")
        tunnel_site = TunnelSite(lab, home, policy=policy, options=("--config", str(home / "appliance.yaml")))
        with tunnel_site:
            yield tunnel_site


@pytest.fixture
def laptop(site: TunnelSite, tmp_path: Path) -> Iterator[ScriptHost]:
    with ScriptHost(site.ocu, tmp_path / "laptop") as host:
        yield host


def awaited(site: TunnelSite, name: str, out: Path, *options: str, verb: str = "add") -> str:
    done = site.appliance.rosrv(
        "host", verb, name, "--appliance", MIDDLE, "--token", "--output", str(out), "--json", *options
    )
    return str(json.loads(done.stdout)["token"])


def row(site: TunnelSite, name: str) -> dict[str, Any]:
    return next(host for host in site.hosts() if host["name"] == name)


def test_a_laptop_joins_renews_and_leaves(site: TunnelSite, laptop: ScriptHost, tmp_path: Path) -> None:
    script = tmp_path / "join.sh"
    before = laptop.files()
    token = awaited(site, "laptop", script)
    assert row(site, "laptop")["state"] == "awaited"
    assert token not in script.read_text()
    mark = site.mark
    joined = laptop.run("sh", str(script), token)
    site.recorded(mark, event="tunnel up")
    assert "established" in laptop.log()
    address = re.findall(r"ROS_IP=(\S+)", joined.stdout)[0]
    found = row(site, "laptop")
    assert (found["state"], found["address"], found["token_expires"]) == ("up", address, None)
    nodes_talk(site, laptop, address)
    closed(site, laptop)
    forged(site, laptop)
    again(site, laptop, script)
    renew(site, laptop)
    leave(site, laptop, before)
    refused = laptop.run("sh", str(script), token, check=False)
    assert refused.returncode == 1
    assert "403" in refused.stderr
    assert "already used" in refused.stderr


def nodes_talk(site: TunnelSite, laptop: ScriptHost, address: str) -> None:
    laptop.address = address
    with (
        RosSession(MASTER, site.home, site.robot) as on_robot,
        RosSession(f"http://{OWN}:11311", site.home, laptop) as on_laptop,
    ):
        on_laptop.talker("roscpp", "/orders", name="boss")
        on_robot.listener("rospy", "/orders", name="arm").wait_for(event="received")


def closed(site: TunnelSite, laptop: ScriptHost) -> None:
    rules = laptop.run("nft", "list", "table", "inet", "rosrv_protect").stdout
    assert OWN in rules
    assert row(site, "laptop")["ports"]["state"] == "unknown"
    ready = site.appliance.ready
    (site.home / "api.pem").write_text((site.appliance.state / "api/certificate.pem").read_text())
    told = site.attacker.popen(
        [
            ROSRV, "protect", "--check", OCU, "--ports", "40000-40049", "--as", "laptop", "--within", "1s",
            "--api", f"https://{MIDDLE}:{API}", "--api-ca", str(site.home / "api.pem"),
        ],
        env={"ROSRV_TOKEN": str(ready["token"]), "PATH": os.environ["PATH"]},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )  # fmt: skip
    out, _ = told.communicate(timeout=60)
    assert told.returncode == 0, out
    assert "the ports of laptop are closed" in out
    seen = row(site, "laptop")["ports"]
    assert (seen["state"], seen["open"], seen["who"]) == ("closed", [], "first")
    assert site.appliance.status()["ipsec"]["ports"]["laptop"]["state"] == "closed"


def forged(site: TunnelSite, laptop: ScriptHost) -> None:
    before = dropped(laptop)
    unknown = site.attacker.namespace
    interfaces.add_address(unknown, "lo", f"{OWN}/32")
    try:
        with unknown.inside(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.bind((OWN, 0))
            sock.sendto(b"forged", (OCU, 20_000))  # the ports of nodes or another: none
        deadline = time.monotonic() + LIMIT
        while dropped(laptop) == before:
            assert time.monotonic() < deadline, "the forged datagram passed the laptop's firewall"
    finally:
        interfaces.delete_address(unknown, "lo", f"{OWN}/32")


def dropped(laptop: ScriptHost) -> int:
    rules = laptop.run("nft", "list", "table", "inet", "rosrv_tunnel").stdout
    return int(re.findall(rf"ip saddr {OWN} counter packets (\d+) bytes \d+ drop", rules)[0])


def again(site: TunnelSite, laptop: ScriptHost, script: Path) -> None:
    serial = row(site, "laptop")["serial"]
    mark = site.mark
    earlier = [laptop.run("cat", f"/run/rosrv/{what}.pid").stdout.strip() for what in ("keep", "renew")]
    done = laptop.run("sh", str(script))
    for pid in earlier:
        gone = laptop.run("sh", "-c", f"! kill -0 {pid} || grep -q ') Z ' /proc/{pid}/stat", check=False)
        assert gone.returncode == 0
    assert "already enrolled" in done.stdout
    site.recorded(mark, event="tunnel up")
    assert row(site, "laptop")["serial"] == serial


def renew(site: TunnelSite, laptop: ScriptHost) -> None:
    assert "nothing to do" in laptop.run("/etc/rosrv/renew.sh").stdout
    key = laptop.run("cat", "/etc/swanctl/private/rosrv.key").stdout
    before = row(site, "laptop")["serial"]
    mark = site.mark
    assert "in force" in laptop.run("/etc/rosrv/renew.sh", "--now").stdout
    renewed = site.recorded(mark, event="host renewed")
    assert renewed["detail"]["replaced"] == before
    site.recorded(mark, event="tunnel down")
    site.recorded(mark, event="tunnel up")
    assert laptop.run("cat", "/etc/swanctl/private/rosrv.key").stdout != key
    after = row(site, "laptop")
    assert after["serial"] != before
    assert not after["renewing"]
    revoked = laptop.run("openssl", "crl", "-in", "/etc/swanctl/x509crl/rosrv.crl", "-noout", "-text").stdout
    assert before.upper() not in revoked, "the list is from before the renewal"
    early = laptop.run("/etc/rosrv/renew.sh", "--now", check=False)
    assert early.returncode == 1
    assert "again in" in early.stderr
    fresh = laptop.run("openssl", "crl", "-in", "/etc/swanctl/x509crl/rosrv.crl", "-noout", "-text").stdout
    assert before.upper() in fresh


def leave(site: TunnelSite, laptop: ScriptHost, before: list[str]) -> None:
    mark = site.mark
    laptop.run("/etc/rosrv/leave.sh")
    site.recorded(mark, event="tunnel down")
    left = set(laptop.files()) - set(before) - {"/etc/strongswan.d/charon/kernel-libipsec.conf"}
    assert left == set()
    conf = "/etc/strongswan.d/charon/kernel-libipsec.conf"
    assert "load = no" in laptop.run("cat", conf).stdout
    assert laptop.run("ls", "-A", "/run").stdout.split() == []
    assert laptop.run("nft", "list", "tables").stdout == ""
    eventually(lambda: not commands(laptop), lambda: str(commands(laptop)))


def commands(laptop: ScriptHost) -> list[bytes]:
    found = []
    for pid in laptop.outer.namespace.processes():
        with contextlib.suppress(OSError):  # it has ended by now
            found.append(Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" "))
    return [one for one in found if one and b"sleep infinity" not in one and b"nsenter" not in one]


def test_a_man_in_the_middle_gets_nothing(site: TunnelSite, laptop: ScriptHost, tmp_path: Path) -> None:
    script = tmp_path / "join.sh"
    token = awaited(site, "other", script)
    text = script.read_text()
    pin = re.findall(r'^pin="(.*)"', text, re.MULTILINE)[0]
    script.write_text(text.replace(pin, "sha256//" + "A" * 43 + "="))
    mark = site.mark
    done = laptop.run("sh", str(script), token, check=False)
    assert done.returncode == 1
    assert "one with another key" in done.stderr
    assert row(site, "other")["state"] == "awaited", "the token was not used"
    authority = re.findall(r'^authority="(.*)"', text, re.MULTILINE)[0]
    script.write_text(text.replace(authority, "0" * 64))
    done = laptop.run("sh", str(script), token, check=False)
    assert "is another than the one this script was made for" in done.stderr
    assert not laptop.run("ls", "/etc/rosrv/other/rosrv-other", check=False).stdout
    site.recorded(mark, event="host enrolled")
    site.appliance.rosrv("host", "revoke", "other")


def test_everything_over_rest(site: TunnelSite, laptop: ScriptHost, tmp_path: Path) -> None:
    rest, ask = site.rest(), site.attacker.run
    seen = ask(lambda: rest.get("/v1/hosts"))
    new = {"name": "re.st_e-D", "endpoint": MIDDLE, "how": "kit"}
    made = ask(lambda: rest.post("/v1/hosts", new, match=seen.etag))
    assert made.status == 201, made.body
    assert ask(lambda: rest.post("/v1/hosts", new, match=seen.etag)).status == 412
    join_kit(laptop, tmp_path / "kit", made.body)
    listed, shown = site.is_up("re.st_e-D"), ask(lambda: rest.get("/v1/hosts/re.st_e-D")).json
    flowing = {"bytes_in", "bytes_out", "seconds", "last_seen", "last_seen_utc"}  # the tunnel is in use
    assert {name for name in listed | shown if listed.get(name) != shown.get(name)} <= flowing
    later = ask(lambda: rest.get(f"/v1/hosts/re.st_e-D/kit?endpoint={MIDDLE}"))
    (tmp_path / "later.tar.gz").write_bytes(later.body)
    with tarfile.open(tmp_path / "later.tar.gz") as tar:
        names = tar.getnames()
    assert "rosrv-re.st_e-D/swanctl/x509/rosrv.pem" in names
    assert not [name for name in names if "private" in name]
    mark = site.mark
    again = ask(lambda: rest.post("/v1/hosts/re.st_e-D/kit", {"endpoint": MIDDLE}, match="*"))
    assert again.status == 200, again.body
    site.recorded(mark, event="tunnel down")
    join_kit(laptop, tmp_path / "again", again.body)
    mark = site.mark
    gone = ask(lambda: rest.request("DELETE", "/v1/hosts/re.st_e-D", None, {"If-Match": "*"}))
    assert gone.status == 200, gone.body
    site.recorded(mark, event="tunnel down")
    assert ask(lambda: rest.get("/v1/hosts/re.st_e-D")).json["state"] == "revoked"
    for _time in ("first", "second, when there is nothing to do"):
        assert "has left" in laptop.run("sh", str(tmp_path / "again/rosrv-re.st_e-D/leave.sh")).stdout


def join_kit(laptop: ScriptHost, folder: Path, kit: bytes) -> None:
    folder.mkdir()
    (folder / "kit.tar.gz").write_bytes(kit)
    laptop.run("tar", "-xzf", str(folder / "kit.tar.gz"), "-C", str(folder))
    laptop.run("sh", str(folder / "rosrv-re.st_e-D/join.sh"))


def test_without_its_tunnel_a_host_talks_to_no_false_appliance(
    site: TunnelSite, laptop: ScriptHost, tmp_path: Path
) -> None:
    """A machine that answers at the appliance's tunnel address in the network gets nothing from the host."""
    script = tmp_path / "join.sh"
    laptop.run("sh", str(script), awaited(site, "other", script))
    laptop.run("sh", "-c", "for what in keep charon; do kill -- -$(cat /run/rosrv/$what.pid); done")
    false, inside = site.attacker.namespace, site.ocu.namespace
    interfaces.add_address(false, "lo", f"{OWN}/32")
    interfaces.add_route(inside, f"{OWN}/32", ATTACKER)
    try:
        with false.inside(), socket.create_server((OWN, 11311)):
            eventually(
                lambda: "ipsec0" not in laptop.run("ip", "-brief", "link").stdout, lambda: "charon has ended"
            )
            assert connect(site.ocu, OCU, OWN) == "nothing"
            laptop.run("nft", "delete", "table", "inet", "rosrv_tunnel")
            assert connect(site.ocu, OCU, OWN) == "connected", "only the rules kept it from there"
        laptop.run("sh", "/etc/rosrv/other/rosrv-other/join.sh")  # the honest tunnel is back
    finally:
        interfaces.delete_address(false, "lo", f"{OWN}/32")
        laptop.run("ip", "route", "del", f"{OWN}/32", check=False)
    laptop.run("/etc/rosrv/leave.sh")
    site.appliance.rosrv("host", "revoke", "other")


def test_through_the_tunnel_rest_only_renews(site: TunnelSite, laptop: ScriptHost, tmp_path: Path) -> None:
    script = tmp_path / "join.sh"
    laptop.run("sh", str(script), awaited(site, "narrow", script))
    curl = ("curl", "--silent", "--insecure", "-o", "/dev/null", "-w", "%{http_code}")
    token = f"Authorization: Bearer {site.appliance.ready['token']}"
    inside = f"https://{OWN}:{API}"
    for path, status in (
        ("/v1/hosts", "403"), ("/v1/status", "403"), ("/healthz", "403"), ("/", "403"), ("/v1/enrol", "403"),
        ("/v1/authority", "200"), ("/v1/revocations", "200"),
    ):  # fmt: skip
        assert laptop.run(*curl, "-H", token, inside + path).stdout == status, path
    other = laptop.run(*curl, "-X", "POST", f"{inside}/v1/hosts/laptop/renewed").stdout
    assert other == "403", "not for another host"
    site.appliance.rosrv("host", "revoke", "narrow")


def test_a_short_lived_certificate_is_renewed_in_time(
    site: TunnelSite, laptop: ScriptHost, tmp_path: Path
) -> None:
    script = tmp_path / "join.sh"
    mark = site.mark
    laptop.run("sh", str(script), awaited(site, "brief", script, "--for", "90s"))
    first = site.is_up("brief")
    # The kit's script checks the certificate, which is backdated by an hour: its last third has already begun.
    assert "in force" in laptop.run("/etc/rosrv/renew.sh").stdout
    site.recorded(mark, event="host renewed")
    second = row(site, "brief")
    assert second["serial"] != first["serial"]
    assert second["expires"] >= first["expires"]  # whole seconds: equal on a quick machine
    down = site.recorded(mark, event="tunnel down")
    site.trail.wait_for(
        lambda event: event.get("event") == "tunnel up" and event["sequence"] > down["sequence"],
        since=mark,
        timeout=LONG,
    )
    assert row(site, "brief")["serial"] == second["serial"]
    site.appliance.rosrv("host", "revoke", "brief")


def test_two_hundred_hosts_beside_a_tunnel(site: TunnelSite, laptop: ScriptHost, tmp_path: Path) -> None:
    rest, ask = site.rest(), site.attacker.run
    request = signing_request(make_key(), "many").decode()

    def enrol_many() -> list[int]:
        asked = {"endpoint": MIDDLE, "how": "kit", "request": request}
        return [
            rest.post("/v1/hosts", asked | {"name": f"many-{one}"}, match="*").status for one in range(200)
        ]

    assert set(ask(enrol_many)) == {201}
    script = tmp_path / "join.sh"
    laptop.run("sh", str(script), awaited(site, "last", script))
    site.is_up("last")
    assert len({host["address"] for host in site.hosts()}) == len(site.hosts())
    mark = site.mark
    site.appliance.rosrv("host", "revoke", "last")
    revoked = site.recorded(mark, event="host revoked")
    down = site.recorded(mark, event="tunnel down")
    assert seconds_of(down) - seconds_of(revoked) < allowed(1.0)


def seconds_of(record: dict[str, Any]) -> float:
    return datetime.datetime.fromisoformat(str(record["time"])[:26] + "+00:00").timestamp()


@contextlib.contextmanager
def endless(laptop: ScriptHost, commands: str) -> Iterator[None]:
    loop = laptop.popen(["sh", "-c", f"while :; do {commands}; done >/dev/null 2>&1"], start_new_session=True)
    try:
        yield
    finally:
        os.killpg(loop.pid, signal.SIGKILL)
        loop.wait()


def test_revocation_while_rekeying(site: TunnelSite, laptop: ScriptHost, tmp_path: Path) -> None:
    script = tmp_path / "join.sh"
    joined = laptop.run("sh", str(script), awaited(site, "other", script))
    laptop.address = re.findall(r"ROS_IP=(\S+)", joined.stdout)[0]
    with (
        RosSession(MASTER, site.home, site.robot) as on_robot,
        RosSession(f"http://{OWN}:11311", site.home, laptop) as on_laptop,
    ):
        talker = on_laptop.talker("rospy", "/orders", "--rate", "50", name="boss")
        listener = on_robot.listener("rospy", "/orders", name="arm")
        listener.wait_for(event="received")
        rekey = "swanctl --rekey --ike rosrv; swanctl --rekey --child ros"
        try:
            with endless(laptop, f"{rekey}; swanctl --initiate --child ros --timeout 2"):
                listener.wait_for(event="received", since=len(listener.events) + 20)
                mark = site.mark
                site.appliance.rosrv("host", "revoke", "other")
                revoked = site.recorded(mark, event="host revoked")
                closed = site.recorded(mark, event="connection closed")
                down = site.recorded(mark, event="tunnel down")
                assert max(seconds_of(closed), seconds_of(down)) - seconds_of(revoked) < allowed(1.0)
            # It keeps trying, each time from the start: an earlier attempt may wait minutes for its answer.
            anew = "swanctl --terminate --ike rosrv --force; swanctl --initiate --child ros --timeout 2"
            with endless(laptop, anew):
                # The first count may have begun earlier, with another host of this machine.
                site.recorded(mark, event="denials folded", host=OCU)
                heard = len(listener.seen(event="received"))  # what had arrived before is read by now
                site.recorded(site.mark, event="denials folded", host=OCU)
            assert len(listener.seen(event="received")) == heard
            assert row(site, "other")["state"] == "revoked"
            assert row(site, "other")["remote"] is None
        finally:
            talker.kill()  # it cannot close the tunnel with a message
    laptop.run("/etc/rosrv/leave.sh")
