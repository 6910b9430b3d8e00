import json
import re
import socket
import ssl
from pathlib import Path
from typing import Any

import pytest

from appliance.network.namespaces import Namespace
from appliance.network.scan import scan
from tests.support.docker import ROOT, Compose, namespace_of
from tests.support.rest import Rest
from tests.support.waiting import eventually
from tests.system.containers.conftest import Site

pytestmark = pytest.mark.timeout(1500)  # for the first test: the images are built

MACHINE = "10.79.0.1"
ROBOT_SIDE, OPERATOR_SIDE, OUTSIDE = "172.29.77.2", "172.29.78.2", "172.29.76.2"
LANDSHARK, OCU, TABLET = "172.29.77.10", "172.29.78.20", "172.29.78.66"
NODE_PORTS = range(19001, 26001)
PAGE = ROOT / "docs" / "reference" / "processes.md"
LAST_ATTACK = "stop the master"
# Python runs the health check, sh and cat this test, and nft is a query of the isolation watchdog.
HELPERS = {"tini", "python", "sh", "cat", "nft"}


@pytest.fixture(scope="module")
def attacks(demo: Compose) -> dict[str, dict[str, Any]]:
    demo.wait_for_log("ocu", '"fired"', timeout=120)
    demo.wait_for_log("visitor", LAST_ATTACK, timeout=180)
    lines = demo("logs", "--no-color", "visitor").stdout.splitlines()
    said = [json.loads(line[line.index("{") :]) for line in lines if '"attacked"' in line]
    return {one["attack"]: one for one in said}


def ports_open(where: Namespace, address: str, ports: range) -> tuple[int, ...]:
    return where.run(lambda: scan(address, ports, seconds=3.0)).open


def reaches(where: Namespace, address: str, port: int, family: int = socket.AF_INET) -> str:
    def attempt() -> str:
        with socket.socket(family, socket.SOCK_STREAM) as client:
            client.settimeout(2)
            try:
                client.connect((address, port))
            except OSError as error:
                return type(error).__name__
            return "reached"

    return where.run(attempt)


def test_unmodified_nodes_work_through_the_appliance(demo: Compose) -> None:
    for event in ('"connected"', '"drove"', '"aimed"', '"fired"'):
        demo.wait_for_log("ocu", event, timeout=120)
    status = demo.status()
    assert (status["nodes"] >= 7, status["probe"], status["isolation"]) == (True, "passed", "container")
    nodes = {record["caller_id"] for record in demo.audit("--event", "registered")}
    assert {"/ocu", "/landshark_base", "/landshark_radar"} <= nodes


def test_nodes_have_no_setting_but_the_master(demo: Compose) -> None:
    for service in ("landshark", "ocu"):
        told = demo.engine.inspect(demo.container(service))["Config"]["Env"]
        assert [one for one in told if one.startswith(("ROS_", "ROSRV"))] == [
            "ROS_MASTER_URI=http://appliance:11311",
            "ROS_HOME=/tmp/ros",
        ]


def test_denials_of_the_visitor_name_the_rule(attacks: dict[str, dict[str, Any]], demo: Compose) -> None:
    succeeded = {name for name, attack in attacks.items() if attack["succeeded"]}
    assert succeeded == {"watch the battery"}
    assert len(attacks) >= 12
    resources = {"getSystemState", "shutdownMaster", "/landshark/gps"}

    def all_denied() -> list[dict[str, Any]] | None:
        records = demo.audit("--deny", "--host", TABLET)
        return records if resources <= {record["resource"] for record in records} else None

    denied = eventually(all_denied, demo.story)
    files = {record["rule"]["file"] for record in denied if record["rule"] is not None}
    assert files == {"/etc/rosrv/policies/containers.ini"}


def test_the_story_ends_with_the_denials_and_the_console(
    attacks: dict[str, dict[str, Any]], demo: Compose
) -> None:
    assert attacks
    demo.wait_for_log("story", "Explore:", timeout=120)
    said = demo("logs", "--no-color", "story").stdout
    token = demo.exec("appliance", "cat", "/var/lib/rosrv/first-token").stdout.strip()
    assert f"({TABLET})  " in said
    assert "[Commands]" in said
    assert "https://127.0.0.1:8443/console/" in said
    assert f"Token:    {token}" in said


def test_source_addresses_are_preserved(attacks: dict[str, dict[str, Any]], demo: Compose) -> None:
    assert attacks

    def hosts_of_callers() -> dict[str, str] | None:
        decided = demo.audit("--allow", "--event", "decision")
        hosts = {
            record["caller_id"]: record["host"]
            for record in decided
            if str(record["detail"].get("call")).startswith("register")
        }
        return hosts if {"/ocu", "/landshark_turret", "/tablet"} <= hosts.keys() else None

    hosts = eventually(hosts_of_callers, demo.story)
    assert hosts["/ocu"] == OCU
    assert hosts["/landshark_turret"] == LANDSHARK
    assert hosts["/tablet"] == TABLET
    assert {host for name, host in hosts.items() if name.startswith("/landshark")} == {LANDSHARK}


def test_only_documented_ports_are_published(site: Site, demo: Compose) -> None:
    published = {}
    for service in ("appliance", "landshark", "ocu"):
        ports = demo.engine.inspect(demo.container(service))["NetworkSettings"]["Ports"]
        published[service] = {
            (binding["HostIp"], binding["HostPort"], port)
            for port, bindings in ports.items()
            for binding in bindings or []
        }
    everywhere = {(ip, port, f"{port}/udp") for ip in ("0.0.0.0", "::") for port in ("500", "4500")}
    assert published["appliance"] == {*everywhere, ("127.0.0.1", "8443", "8443/tcp")}
    assert published["landshark"] == published["ocu"] == set()
    assert ports_open(site.laptop.namespace, MACHINE, range(1, 65536)) == ()


def test_this_machine_reaches_the_console_and_the_laptop_does_not(
    site: Site, demo: Compose, tmp_path: Path
) -> None:
    token = demo.exec("appliance", "cat", "/var/lib/rosrv/first-token").stdout.strip()
    certificate = tmp_path / "certificate.pem"

    def ask() -> list[int]:
        certificate.write_text(ssl.get_server_certificate(("127.0.0.1", 8443), timeout=10))
        rest = Rest("https://127.0.0.1:8443", token, certificate)
        return [rest.get(path).status for path in ("/v1/status", "/")]

    assert site.machine.run(ask) == [200, 200]
    assert reaches(site.laptop.namespace, MACHINE, 8443) == "ConnectionRefusedError"
    assert demo.engine.inspect("demo_robot")["Internal"]


def test_an_operator_reaches_the_appliance_only(attacks: dict[str, dict[str, Any]], demo: Compose) -> None:
    assert attacks
    here = namespace_of(demo.engine, demo.container("ocu"))
    found = ports_open(here, OPERATOR_SIDE, range(1, 65536))
    assert 11311 in found
    assert all(port == 11311 or port in NODE_PORTS for port in found), found
    for address in (ROBOT_SIDE, OUTSIDE, LANDSHARK):
        assert ports_open(here, address, range(1, 65536, 199)) == ()
        for port in (8443, 11311):
            assert reaches(here, address, port) not in ("reached", "ConnectionRefusedError")  # no answer
    assert attacks["go past the master"]["answer"][1].startswith("0 of ")


def test_an_unknown_container_reaches_nothing(demo: Compose) -> None:
    name = demo.engine.docker(
        "run", "--detach", "--rm", "--network", "demo_outside", "--entrypoint", "sleep", "rosrv/demo", "300"
    ).stdout.strip()
    try:
        here = namespace_of(demo.engine, name)
        assert ports_open(here, OUTSIDE, range(1, 11311)) == ()
        assert reaches(here, OUTSIDE, 12311) == "ConnectionRefusedError"
        assert ports_open(here, OUTSIDE, range(26001, 65536)) == ()
        assert reaches(here, LANDSHARK, 22) != "reached"
    finally:
        demo.engine.docker("kill", name)


def test_nothing_listens_on_ipv6(demo: Compose) -> None:
    listening = demo.exec("appliance", "ss", "-Htln6").stdout
    assert listening == ""


def documented_rights() -> dict[str, tuple[str, frozenset[str]]]:
    rows = re.findall(r"^\| `([a-z]+)` \| `([a-z-]+)` \| ([^|]*) \|", PAGE.read_text(), re.MULTILINE)
    return {name: (user, frozenset(re.findall(r"[A-Z][A-Z_]+", rights))) for name, user, rights in rows}


def test_every_process_has_the_documented_rights(demo: Compose) -> None:
    numbers = {"NET_ADMIN": 12, "NET_BIND_SERVICE": 10, "SETUID": 7, "SETGID": 6, "KILL": 5, "CHOWN": 0}
    documented = documented_rights()

    def running() -> tuple[dict[str, int], dict[int, dict[str, str]]] | None:
        roles = {row["role"]: row["pid"] for row in demo.status()["processes"]}
        text = demo.exec("appliance", "sh", "-c", "cat /proc/[0-9]*/status || true").stdout
        rows = [
            dict(line.split(":\t", 1) for line in f"Name:\t{part}".splitlines() if ":\t" in line)
            for part in text.split("Name:\t")[1:]
        ]
        found = {int(row["Pid"]): row for row in rows}
        ended = set(roles.values()) - set(found)  # for example the compiler, which was idle
        # The engine's health check begins under the name of the engine's own program.
        begins = any(row["Name"].startswith("runc:") for row in rows)
        return None if ended or begins else (roles, found)

    seen, processes = eventually(running, demo.story)
    assert set(seen) <= set(documented)
    users = dict(
        line.split(":")[::2][:2] for line in demo.exec("appliance", "getent", "passwd").stdout.splitlines()
    )
    for role, pid in seen.items():
        fields = processes[pid]
        user, rights = documented[role]
        assert set(fields["Uid"].split()) == {users[user]}, role
        mask = sum(1 << numbers[name] for name in rights)
        assert int(fields["CapPrm"], 16) == mask, role
        assert int(fields["CapEff"], 16) == mask, role
        assert fields["NoNewPrivs"] == "1", role
    others = sorted(row["Name"] for pid, row in processes.items() if pid not in seen.values())
    assert set(others) <= HELPERS, others
    assert len(others) == len(set(others)), others


def test_the_root_file_system_is_read_only(demo: Compose) -> None:
    mounts = demo.exec("appliance", "cat", "/proc/mounts").stdout.splitlines()
    kinds = {line.split()[1]: line.split()[2:4] for line in mounts}
    assert "ro" in kinds["/"][1].split(",")
    writable = {
        place
        for place, (kind, options) in kinds.items()
        if "rw" in options.split(",") and kind not in ("proc", "devpts", "mqueue", "cgroup", "cgroup2")
    }
    system = {"/dev", "/dev/shm", "/proc/keys", "/proc/timer_list", "/proc/kcore", "/etc/resolv.conf"}
    system |= {"/etc/hostname", "/etc/hosts", "/sys/fs/cgroup"}
    assert writable - system == {"/var/lib/rosrv", "/tmp", "/run"}
    for place in ("/tmp", "/run"):
        assert {"noexec", "nosuid", "nodev"} <= set(kinds[place][1].split(","))
    for folder in ("policies", "monitors", "ipsec"):
        assert "ro" in kinds[f"/etc/rosrv/{folder}"][1].split(",")


def test_packets_are_not_forwarded_between_networks(demo: Compose) -> None:
    assert demo.exec("appliance", "cat", "/proc/sys/net/ipv4/ip_forward").stdout.strip() == "0"


def test_a_policy_is_changed_while_the_robot_runs(demo: Compose) -> None:
    file = demo.directory / "policies" / "containers.ini"
    before = file.read_text()
    file.write_text(before.replace("/landshark/gps ", "/landshark/odom = vehicle\n/landshark/gps ", 1))
    try:
        assert "revision 2" in demo("exec", "-T", "appliance", "rosrv", "policy", "reload").stdout
        taken = demo.audit("--event", "revoked", caller_id="/ocu")
        assert "/landshark/odom" in {record["resource"] for record in taken}
    finally:
        file.write_text(before)
        demo.exec("appliance", "rosrv", "policy", "reload")
    moment = demo.engine.docker("info", "--format", "{{.SystemTime}}").stdout.strip()
    demo.wait_for_log("ocu", '"position"', since=moment)
    checked = demo.exec("appliance", "rosrv", "policy", "check", "policies/containers.ini")
    assert "policies/containers.ini is valid" in checked.stdout
    broken = demo.directory / "policies" / "broken.ini"
    broken.write_text("[Publishers\n")
    assert (
        demo.exec("appliance", "rosrv", "policy", "check", "policies/broken.ini", check=False).returncode == 1
    )
