"""The firewall rules of an enrolled host, from its kit's own scripts with the real `nft`, without a tunnel."""

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


class Enrolled(ScriptHost):
    """A host with the kit's files in `/etc/rosrv`."""

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
            host.put(
                f"/etc/rosrv/{path}",
                "\n".join(x for x in quick.splitlines() if "ifname !=" not in x),
                oct(mode)[2:],
            )
        yield host


def test_rules_that_another_program_removes_come_back(laptop: Enrolled) -> None:
    """In the kit itself, `keep.sh` looks each 10 s."""
    assert "    sleep 10\n" in next(text for path, text, _mode in members(KIT) if path == "keep.sh")
    tables = ("rosrv_protect", "rosrv_tunnel")
    laptop.run("nft", "-f", "/etc/rosrv/protect.nft")
    loaded = [laptop.table(table) for table in tables]
    assert all(APPLIANCE in rules for rules in loaded)
    laptop.run(
        "sh",
        "-c",
        "mkdir -p /run/rosrv; setsid /etc/rosrv/keep.sh >/run/rosrv/keep.log 2>&1 & echo $! >/run/rosrv/keep.pid",
    )
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
