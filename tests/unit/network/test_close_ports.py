import re
from pathlib import Path

import pytest

from appliance.network.close_ports import (
    LocalCallers,
    local_port_range,
    parse_address,
    parse_ports,
    parse_services,
    protection,
)
from appliance.network.firewall.firewall_rules import PortRange

ROOT = Path(__file__).parents[3]
RANGE = PortRange(32768, 60999)


def test_the_file_closes_the_range_after_all_that_stays_open() -> None:
    services = parse_services(["tcp/40022,udp/40123", "tcp/41000-41009", "tcp/40022"])
    text = protection(["192.168.1.20", "fd00::20"], RANGE, services)
    rules = [line.strip() for line in text.splitlines() if line.startswith("        ")]
    assert rules == [
        "type filter hook input priority filter; policy accept;",
        'iifname "lo" accept',
        "ip saddr { 192.168.1.20 } accept",
        "ip6 saddr { fd00::20 } accept",
        "tcp dport 40022 accept",
        "udp dport 40123 accept",
        "tcp dport 41000-41009 accept",
        "tcp dport 32768-60999 tcp flags & (syn | ack) == syn counter reject with tcp reset",
        "udp dport 32768-60999 ct state { new, invalid } counter drop",
        "type filter hook postrouting priority 300; policy accept;",
        "ip daddr { 192.168.1.20 } tcp flags & (syn | ack) == syn iif != 0 fib saddr type local counter drop",
        "ip6 daddr { fd00::20 } tcp flags & (syn | ack) == syn iif != 0 fib saddr type local counter drop",
    ]
    assert text.count("delete table inet rosrv_protect") == 1


def test_strict_rules_refuse_all_other_programs_of_the_machine() -> None:
    """A packet without an owner is refused also, and answers and connections that are there are not concerned."""
    callers = LocalCallers(("robot", "1001", "robot"), ("system.slice/robot.service",))
    services = parse_services(["tcp/40022"])
    plain = protection(["192.168.1.20"], RANGE, services)
    text = protection(["192.168.1.20"], RANGE, services, strict=callers)
    chain = text.partition("    chain local {\n")[2]
    assert [line.strip() for line in chain.splitlines()] == [
        "type filter hook output priority filter; policy accept;",
        'oifname != "lo" accept',
        "tcp dport 40022 accept",
        "meta skuid { robot, 1001 } accept",
        'socket cgroupv2 level 2 "system.slice/robot.service" accept',
        "tcp dport 32768-60999 tcp flags & (syn | ack) == syn counter reject with tcp reset",
        "udp dport 32768-60999 ct state { new, invalid } counter drop",
        "}",
        "}",
    ]
    assert text.partition("    chain local {\n")[0] + "}\n" == plain.replace(
        "loopback and", "robot, 1001, robot, system.slice/robot.service of this machine and"
    )


@pytest.mark.parametrize(
    ("users", "groups", "why"),
    [
        ((), (), "needs the user"), (("a b",), (), "--user 'a b'"), (("Robot",), (), "--user"), (("x}",), (), "--user"),
        ((), ("/system.slice",), "--cgroup"), ((), ('a"; drop',), "--cgroup"), ((), ("a//b",), "--cgroup"),
        ((), ("../a/",), "--cgroup"), (("",), (), "--user"),
    ],
)  # fmt: skip
def test_a_wrong_caller_is_named(users: tuple[str, ...], groups: tuple[str, ...], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        LocalCallers(users, groups)


def test_no_appliance_is_an_error() -> None:
    """The file would block every host, even the appliance."""
    with pytest.raises(ValueError, match="at least one appliance"):
        protection([], RANGE, ())


@pytest.mark.parametrize(
    "text", ["ssh", "tcp", "tcp/", "tcp/0", "tcp/65536", "icmp/1", "tcp/9-3", "tcp/22;", ""]
)
def test_a_wrong_service_is_named(text: str) -> None:
    with pytest.raises(ValueError, match=r"--open .* is not a service"):
        parse_services([f"tcp/22,{text}"])


@pytest.mark.parametrize("text", ["", "x", "1-x", "0-5", "5-1", "1-70000", "-5"])
def test_a_wrong_range_is_named(text: str) -> None:
    with pytest.raises(ValueError, match="is not a range of ports"):
        parse_ports(text)


@pytest.mark.parametrize(
    "text", ["0.0.0.0", "::", "127.0.0.1", "::1", "224.0.0.1", "10.0.0.0/8", "10.0.0.1; x"]
)
def test_an_address_that_no_appliance_can_have_is_named(text: str) -> None:
    with pytest.raises(ValueError, match="appliance"):
        parse_address(text)


def test_the_default_range_is_the_kernels() -> None:
    port_range = local_port_range()
    assert 1 <= port_range.first < port_range.last <= 65535


def test_units_that_come_before_the_network_fit_into_the_boot() -> None:
    """They come after the firewalls that flush all rules. Default dependencies close a cycle through cloud-init."""
    places = [path for root in ("appliance", "distribution", "docs") for path in (ROOT / root).rglob("*.*")]
    texts = [path.read_text() for path in places if path.suffix in (".service", ".sh", ".md")]
    units = [unit for text in texts for unit in re.split(r"^(?=\[Unit\]\n)", text, flags=re.MULTILINE)[1:]]
    early = [unit for unit in units if re.search(r"^Before=.*\bnetwork-pre\.target", unit, re.MULTILINE)]
    assert len(early) >= 4
    for unit in early:
        assert "\nDefaultDependencies=no\n" in unit
        assert re.search(
            r"^After=.*\bnftables\.service netfilter-persistent\.service ufw\.service$", unit, re.MULTILINE
        )


def test_no_page_flushes_the_rules_of_a_machine() -> None:
    """Starting Debian's service `nftables` deletes all rules, such as those that Docker added since the boot."""
    flushing = re.compile(r"systemctl (?:enable --now|start|restart|reload) nftables")
    assert [page.name for page in (ROOT / "docs").rglob("*.md") if flushing.search(page.read_text())] == []
