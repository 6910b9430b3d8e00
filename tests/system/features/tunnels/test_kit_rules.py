"""The firewall rules of an enrolled host, from its kit's own scripts with the real `nft`, without a tunnel."""

import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.features.tunnels.enrolment_kit import members
from appliance.features.tunnels.kits import KitOptions, kit_of
from appliance.features.tunnels.tunnel_answers import KitParts
from appliance.network.close_ports import protection
from appliance.network.firewall.firewall_rules import PortRange
from examples.landshark.lab import Lab
from tests.support.requirements import need_program, need_root
from tests.support.script_host import ScriptHost
from tests.support.sources import ROOT
from tests.support.waiting import eventually

APPLIANCE = "10.113.11.1"
PORTS = PortRange(32768, 60999)
KIT = kit_of(
    KitParts(
        revision=1, name="laptop", address="10.113.11.2", appliance=APPLIANCE, master=f"http://{APPLIANCE}:11311",
        rest_url="", rest_trouble="REST is off", pin="", warning=None, serial="1a", expires=0.0, certificate="",
        authority="",
    ),
    KitOptions("192.168.1.20"),
    "KEY\n",
)  # fmt: skip
OTHER = protection(["192.168.1.20"], PORTS, ())
OWN = protection([APPLIANCE, "192.168.1.20"], PORTS, ())
REMOVALS = {
    "nft flush ruleset": "flush ruleset",
    "systemctl start nftables": "flush ruleset\ntable inet filter { chain input { }; }",
    "closed ports": "delete table inet rosrv_protect",
    "clear text": "delete table inet rosrv_tunnel",
    "one table's rules": "flush table inet rosrv_tunnel",
    "rosrv protect": OTHER,
}
KEEPER = "setsid /etc/rosrv/keep.sh >/run/rosrv/keep.log 2>&1 & echo $! >/run/rosrv/keep.pid"
PROGRAMS = {
    "dpkg-query": "echo install ok installed",
    "swanctl": "echo INSTALLED",
    "ping": "",
    "systemctl": f"""\
end() {{ kill -- "-$(cat /run/rosrv/keep.pid)"; rm /run/rosrv/keep.pid; }} 2>/dev/null
case "$*" in
"is-enabled "*) [ -e /run/rosrv/keep.pid ];;
*"start rosrv-protect.service" | *"start rosrv-ports.service")
    sed -n 's/^ExecStart=//p' "/etc/systemd/system/${{2}}" | sh -e;;
"restart rosrv-tunnel.service") mkdir -p /run/rosrv; {KEEPER};;
*" rosrv-tunnel.service"* | boot) end; true;;
esac
""",
}
ORDERS = {
    "join": "kit",
    "join leave": "none",
    "join apply-other": "kit",
    "join apply-own": "own",
    "join apply-own leave": "none",
    "apply-other join": "kit",
    "join leave apply-other": "other",
    "store-other join": "kit",
    "store-other join boot": "kit",
    "store-other join flush": "kit",
    "store-other join boot leave": "other",
    "store-other join leave boot": "other",
    "join store-other boot": "kit",
    "join store-own boot": "own",
    "join store-own flush": "own",
    "join store-own join": "own",
    "join store-own boot leave": "own",
    "join store-own leave boot": "own",
}
BOOT = """kept=$(ls /run/rosrv/keep.pid) && systemctl boot
nft flush ruleset
first=ports second=protect
! grep -q "^Before=.*rosrv-ports" /etc/systemd/system/rosrv-protect.service || first=protect second=ports
systemctl start "rosrv-$first.service"
systemctl start "rosrv-$second.service"
[ -z "$kept" ] || systemctl restart rosrv-tunnel.service
"""
DOCUMENTED = ROOT / "docs/close-the-ports.md"


class Enrolled(ScriptHost):
    """A host with the kit in `/etc/kit`."""

    def put(self, path: str, text: str, mode: str = "0644") -> None:
        self.run(
            "sh", "-c", 'mkdir -p "${1%/*}"; printf %s "$2" > "$1"; chmod "$3" "$1"', "sh", path, text, mode
        )

    def table(self, name: str) -> str:
        return self.run("nft", "-s", "list", "table", "inet", name, check=False).stdout

    def load(self, rules: str) -> None:
        self.put("/run/loaded.nft", rules)
        self.run("nft", "-f", "/run/loaded.nft")


@pytest.fixture
def laptop(tmp_path: Path) -> Iterator[Enrolled]:
    need_root()
    need_program("nft", "nftables")
    with Lab("rosrv-rules") as lab, Enrolled(lab.host("laptop", "10.88.0.7/24"), tmp_path / "laptop") as host:
        for path, text, mode in members(KIT):
            quick = re.sub(r"sleep 10$", "sleep 0.2", text, flags=re.MULTILINE) if path == "keep.sh" else text
            host.put(f"/etc/kit/{path}", quick, f"{mode:o}")
        yield host


def test_rules_that_another_program_removes_come_back(laptop: Enrolled) -> None:
    """In the kit itself, `keep.sh` looks each 10 s."""
    assert "    sleep 10\n" in next(text for path, text, _mode in members(KIT) if path == "keep.sh")
    tables = ("rosrv_protect", "rosrv_tunnel")
    laptop.run("sh", "-c", "mkdir /etc/rosrv /run/rosrv; cp /etc/kit/*.sh /etc/rosrv")
    laptop.run("sh", "-c", "sed '/ipsec missing/d' /etc/kit/protect.nft >/etc/rosrv/protect.nft")
    laptop.run("nft", "-f", "/etc/rosrv/protect.nft")
    loaded = [laptop.table(table) for table in tables]
    assert all(APPLIANCE in rules for rules in loaded)
    laptop.run("sh", "-c", KEEPER)
    for rules in REMOVALS.values():
        laptop.load(rules)
        eventually(
            lambda: [laptop.table(table) for table in tables] == loaded,
            lambda: laptop.run("nft", "list", "ruleset").stdout,
        )
    laptop.load(OWN)
    own = laptop.table("rosrv_protect")
    laptop.run("nft", "delete", "table", "inet", "rosrv_tunnel")
    eventually(lambda: laptop.table("rosrv_tunnel") == loaded[1], "the rules for the tunnel are back")
    assert laptop.table("rosrv_protect") == own, "rules that let the appliance in stay"
    assert "are in force again" in laptop.run("cat", "/run/rosrv/keep.log").stdout
    laptop.run("/etc/rosrv/leave.sh")
    assert [laptop.table(table) for table in tables] == ["", ""]


@pytest.fixture
def booted(laptop: Enrolled, tmp_path: Path) -> Enrolled:
    """A host where a script stands for `systemctl`, and others for a tunnel that is up."""
    for name, text in PROGRAMS.items():
        laptop.put(f"{tmp_path}/bin/{name}", f"#!/bin/sh\n{text}", "0755")
    laptop.put("/etc/strongswan.d/charon/kernel-libipsec.conf", "")
    laptop.run("mkdir", "-p", "/run/systemd/system")
    return laptop


@pytest.mark.parametrize("order", ORDERS)
def test_each_order_of_stored_rules_and_a_kit(booted: Enrolled, tmp_path: Path, order: str) -> None:
    """The rules in force admit the appliance while its tunnel is kept, and stored ones count otherwise."""
    expected = {"none": ""}
    for whose, rules in {"kit": protection([APPLIANCE], PORTS, ()), "own": OWN, "other": OTHER}.items():
        booted.load(rules)
        expected[whose] = booted.table("rosrv_protect")
    booted.run("nft", "flush", "ruleset")
    path = f"{tmp_path}/bin:{os.environ['PATH']}"
    (unit,) = re.findall(
        r"(?s)rosrv-ports\.service <<'UNIT'\n(.*?)^UNIT$", DOCUMENTED.read_text(), re.MULTILINE
    )
    for step in order.split():
        verb, _, whose = step.partition("-")
        rules = OWN if whose == "own" else OTHER
        if verb in ("join", "leave"):
            booted.run("sh", f"/etc/kit/{verb}.sh", PATH=path)
        elif verb == "flush":
            booted.run("nft", "flush", "ruleset")
        elif verb == "boot":
            booted.run("sh", "-c", BOOT, PATH=path)
        else:
            booted.load(rules)
        if verb == "store":
            booted.put("/etc/rosrv-protect.nft", rules)
            booted.put("/etc/systemd/system/rosrv-ports.service", unit)
    eventually(
        lambda: (
            booted.table("rosrv_protect") == expected[ORDERS[order]]
            and bool(booted.table("rosrv_tunnel")) == ("leave" not in order)
        ),
        lambda: booted.run("nft", "list", "ruleset").stdout,
    )
