import contextlib
import itertools
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.network.firewall.backend import BackendMissingError, FirewallError
from appliance.network.firewall.backend_check import prove
from appliance.network.firewall.firewall import BackendChoice, Firewall
from appliance.network.firewall.firewall_rules import (
    Chain,
    FirewallSettings,
    PacketRule,
    PacketVerdict,
    PortRange,
    RateLimit,
)
from appliance.network.firewall.iptables import IptablesBackend
from appliance.network.firewall.nft import NftBackend
from appliance.network.probe import PROBE_UID, ConnectOutcome, probe_port
from examples.landshark.lab import INTERFACE, Host, Lab
from tests.support.requirements import need_program
from tests.system.network.test_isolation import serving

CONTROL, ROSMASTER, OTHER = 61011, 61012, 61055
LOOPBACKS = ("127.0.0.1", "::1")
BACKENDS: tuple[BackendChoice, ...] = ("nft", "iptables")

CLIENT = """
import errno, socket, sys
for target in sys.argv[1:]:
    address, port = target.rsplit("/", 1)
    try:
        socket.create_connection((address, int(port)), timeout=10).close()
        print("reached")
    except ConnectionRefusedError:
        print("refused")
    except OSError as error:
        # EHOSTUNREACH: the packets of neighbour discovery are dropped, too
        lost = isinstance(error, TimeoutError) or error.errno == errno.EHOSTUNREACH
        print("dropped" if lost else f"error {error}")
"""


@pytest.fixture(autouse=True)
def _machine() -> None:
    need_program("iptables-legacy", "iptables")


def connect(host: Host, uid: int, *targets: tuple[str, int]) -> list[str]:
    process = host.popen(
        ["/usr/bin/python3", "-I", "-S", "-c", CLIENT, *(f"{address}/{port}" for address, port in targets)],
        user=uid,
        group=uid,
        extra_groups=[],
        cwd="/",
        stdout=subprocess.PIPE,
        text=True,
    )
    out, _ = process.communicate(timeout=60)
    return str(out).splitlines()


@contextlib.contextmanager
def listening(host: Host, address: str = "::", port: int = 0) -> Iterator[int]:
    with host.entered():
        family = socket.AF_INET6 if ":" in address else socket.AF_INET
        server = socket.create_server(
            (address, port), family=family, dualstack_ipv6=address == "::", backlog=1000
        )
    with server:
        yield server.getsockname()[1]


def settings(port: int, **others: Any) -> FirewallSettings:
    return FirewallSettings(
        control_uid=CONTROL,
        rosmaster_uid=ROSMASTER,
        rosmaster_port=port,
        **others,
    )


def ruleset(host: Host) -> str:
    commands = ("nft -s list ruleset", "iptables-legacy-save -t filter", "ip6tables-legacy-save -t filter")
    outputs = []
    for command in commands:
        process = host.popen(command.split(), stdout=subprocess.PIPE, text=True)
        out, _ = process.communicate(timeout=30)
        outputs.append("\n".join(line for line in out.splitlines() if not line.startswith(("#", ":"))))
    return "\n".join(outputs)


@pytest.mark.real
@pytest.mark.parametrize("backend", BACKENDS)
def test_only_control_opens_connections_to_rosmaster(
    protected: Host, attacker: Host, backend: BackendChoice
) -> None:
    firewall = Firewall(protected.namespace, backend)
    own = (protected.address, protected.address6)
    with listening(protected) as port:
        everywhere = [(address, port) for address in (*LOOPBACKS, *own)]
        assert connect(protected, OTHER, *everywhere) == ["reached"] * 4, "without rules"
        assert firewall.install(settings(port)) == backend
        assert connect(protected, CONTROL, *everywhere) == ["reached"] * 4
        for uid in (0, OTHER, ROSMASTER):
            assert connect(protected, uid, *everywhere) == ["refused"] * 4, f"uid {uid}"
        assert connect(attacker, CONTROL, *((address, port) for address in own)) == ["refused"] * 2
        firewall.remove()
        assert connect(protected, OTHER, *everywhere) == ["reached"] * 4, "after removal"


@pytest.mark.parametrize("backend", BACKENDS)
def test_only_rosmaster_reaches_the_master_side_endpoint(
    protected: Host, attacker: Host, backend: BackendChoice
) -> None:
    firewall = Firewall(protected.namespace, backend)
    with listening(protected) as port, listening(protected) as inner:
        firewall.install(settings(port))
        firewall.update(settings(port, inner_port=inner))
        local = [(address, inner) for address in LOOPBACKS]
        assert connect(protected, ROSMASTER, *local) == ["reached"] * 2
        assert connect(protected, CONTROL, *local) == ["refused"] * 2
        assert connect(protected, 0, *local) == ["refused"] * 2
        assert connect(attacker, 0, (protected.address, inner)) == ["refused"]
        assert connect(protected, CONTROL, ("127.0.0.1", port)) == ["reached"]
        assert connect(protected, OTHER, ("127.0.0.1", port)) == ["refused"]


@pytest.mark.parametrize("backend", BACKENDS)
def test_open_connections_and_other_ports_stay_usable(protected: Host, backend: BackendChoice) -> None:
    firewall = Firewall(protected.namespace, backend)
    with protected.entered():
        server = socket.create_server(("127.0.0.1", 0))
        port = server.getsockname()[1]
        client = socket.create_connection(("127.0.0.1", port), timeout=10)
    with server, client, listening(protected) as other:
        peer, _ = server.accept()
        with peer:
            firewall.install(settings(port))
            client.sendall(b"ping")
            assert peer.recv(4) == b"ping"
            assert connect(protected, OTHER, ("127.0.0.1", other)) == ["reached"]


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_port_opened_by_notrack_rules_stays_closed(protected: Host, backend: BackendChoice) -> None:
    run_in(protected, "iptables-legacy -t raw -A OUTPUT -o lo -j NOTRACK")
    run_in(protected, "iptables-legacy -t raw -A PREROUTING -i lo -j NOTRACK")
    firewall = Firewall(protected.namespace, backend)
    with listening(protected) as port:
        firewall.install(settings(port))
        assert connect(protected, OTHER, ("127.0.0.1", port)) == ["refused"]
        assert connect(protected, CONTROL, ("127.0.0.1", port)) == ["reached"]


def run_in(host: Host, command: str) -> None:
    process = host.popen(command.split())
    assert process.wait(timeout=30) == 0, command


@pytest.mark.parametrize("backend", BACKENDS)
def test_foreign_rules_are_not_touched(protected: Host, backend: BackendChoice) -> None:
    run_in(protected, "iptables-legacy -A INPUT -p tcp --dport 9 -m comment --comment foreign -j DROP")
    run_in(protected, "ip6tables-legacy -A OUTPUT -p udp --dport 9 -m length --length 1:50 -j DROP")
    run_in(protected, "nft add table inet foreign")
    run_in(protected, "nft add chain inet foreign ROSRV-IN { type filter hook input priority 5 ; }")
    before = ruleset(protected)
    firewall = Firewall(protected.namespace, backend)
    firewall.install(settings(11312, api_port=8443))
    once = ruleset(protected)
    firewall.install(settings(11312, api_port=8443))
    assert ruleset(protected) == once
    Firewall(protected.namespace, backend).install(settings(11312, api_port=8443))
    assert ruleset(protected) == once, "after a restart of the appliance"
    assert all(line in once for line in before.splitlines())
    firewall.remove()
    assert ruleset(protected) == before
    firewall.remove()


@pytest.mark.parametrize(("earlier", "later"), list(itertools.permutations(BACKENDS)))
def test_leftovers_of_the_other_back_end_are_replaced(
    protected: Host, earlier: BackendChoice, later: BackendChoice
) -> None:
    before = ruleset(protected)
    Firewall(protected.namespace, earlier).install(settings(11312))
    firewall = Firewall(protected.namespace, later)
    firewall.install(settings(11313))
    assert "11312" not in ruleset(protected)
    firewall.remove()
    assert ruleset(protected) == before


@pytest.mark.parametrize("backend", BACKENDS)
def test_only_management_networks_reach_the_rest_port(
    lab: Lab, protected: Host, backend: BackendChoice
) -> None:
    manager = lab.host("manager", "10.77.0.5/24", "fd77::5/64")
    unknown = lab.host("unknown", "10.77.0.6/24", "fd77::6/64")
    firewall = Firewall(protected.namespace, backend)
    with listening(protected) as api:
        firewall.install(settings(11312, api_port=api, api_networks=("10.77.0.5", "fd77::5/128")))
        targets = [(address, api) for address in (protected.address, protected.address6)]
        assert connect(manager, OTHER, *targets) == ["reached"] * 2
        assert connect(unknown, OTHER, *targets) == ["refused"] * 2
        assert connect(protected, OTHER, ("127.0.0.1", api)) == ["reached"]


@pytest.mark.parametrize("backend", BACKENDS)
def test_clear_text_packets_of_a_tunnelled_host_are_dropped(
    lab: Lab, protected: Host, backend: BackendChoice
) -> None:
    spoofer = lab.host("spoofer", "10.77.0.9/24", "fd77::9/64")
    honest = lab.host("honest", "10.77.0.10/24")
    firewall = Firewall(protected.namespace, backend)
    with listening(protected) as port, listening(spoofer) as back:
        targets = [(address, port) for address in (protected.address, protected.address6)]
        firewall.install(settings(11312, tunnel_only=("10.77.0.9", "fd77::9")))
        assert connect(spoofer, 0, *targets) == ["dropped"] * 2
        assert connect(protected, 0, (spoofer.address, back))[0] != "reached"
        assert connect(honest, 0, (protected.address, port)) == ["reached"]
        firewall.update(settings(11312, tunnel_only=("10.77.0.9",), tunnel_interface=INTERFACE))
        assert connect(spoofer, 0, *targets) == ["reached"] * 2, "arrived on the tunnel's interface"
        firewall.update(settings(11312, tunnel_only=("10.77.0.9",), tunnel_interface="ipsec0"))
        assert connect(spoofer, 0, *targets) == ["dropped", "reached"]


@pytest.mark.parametrize("backend", BACKENDS)
def test_only_the_flooding_host_is_slowed_down(
    lab: Lab, protected: Host, attacker: Host, backend: BackendChoice
) -> None:
    honest = lab.host("honest", "10.77.0.10/24", "fd77::10/64")
    firewall = Firewall(protected.namespace, backend)
    limit = RateLimit(per_second=1, burst=5)
    with serving(protected.namespace, 11311) as master, serving(protected.namespace, 20000) as node:
        firewall.install(
            settings(11312, master_port=11311, node_ports=PortRange(20000, 20009), new_connections=limit)
        )
        for address in (protected.address, protected.address6):
            opened = flood(attacker, address, (master, node), 15)
            assert 5 <= opened <= 12, f"{opened} of 30 came through to {address}"
            assert flood(honest, address, (master, node), 1) == 2
        dropped = [rule for rule in firewall.report().rules if "per host" in rule.purpose]
        assert sum(rule.packets for rule in dropped) >= 30


def test_hosts_without_a_bucket_have_one_common_limit(
    lab: Lab, protected: Host, attacker: Host, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("appliance.network.firewall.nft._METER_SIZE", 1)
    others = [lab.host(f"other{number}", f"10.77.0.{number}/24", f"fd77::{number}/64") for number in (11, 12)]
    firewall = Firewall(protected.namespace, "nft")
    limit = RateLimit(per_second=1, burst=5)
    with serving(protected.namespace, 11311) as master:
        firewall.install(settings(11312, master_port=11311, new_connections=limit))
        for address in (protected.address, protected.address6):
            assert flood(attacker, address, (master,), 1) == 1  # takes the one bucket
            opened = sum(flood(other, address, (master,), 15) for other in others)
            assert 5 <= opened <= 12, f"{opened} of 30 came through"
            assert flood(attacker, address, (master,), 1) == 1
        (status,) = [rule for rule in firewall.report().rules if "per host" in rule.purpose]
        assert status.in_force
        assert status.packets >= 30


def flood(host: Host, address: str, servers: tuple[socket.socket, ...], rounds: int) -> int:
    with contextlib.ExitStack() as stack, host.entered():
        for server in servers * rounds:
            target = (address, server.getsockname()[1])
            stack.enter_context(socket.create_connection(target, timeout=5))
        return sum(waiting(server, host) for server in servers)


def waiting(server: socket.socket, host: Host) -> int:
    server.settimeout(0.3)
    found = 0
    with contextlib.suppress(TimeoutError):
        while found < 1000:
            peer, (address, *_) = server.accept()
            peer.close()
            found += address.removeprefix("::ffff:") in (host.address, host.address6)
    return found


def test_legacy_xtables_are_in_force_on_a_kernel_without_ipv6(
    protected: Host, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("appliance.network.firewall.iptables._families", lambda: (4,))
    protected.namespace.sysctl("net.ipv6.conf.all.disable_ipv6", "1")  # no listener can use IPv6 either
    firewall = Firewall(protected.namespace, "iptables")
    firewall.install(settings(11312, tunnel_only=("10.77.0.9", "fd77::9")))
    assert firewall.report().intact
    run_in(protected, "iptables-legacy -D OUTPUT 1")
    assert not firewall.report().intact
    firewall.remove()


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_report_counts_packets_and_misses_removed_rules(protected: Host, backend: BackendChoice) -> None:
    firewall = Firewall(protected.namespace, backend)
    assert firewall.report().backend is None
    with listening(protected) as port:
        firewall.install(settings(port))
        connect(protected, OTHER, *((address, port) for address in LOOPBACKS))
        report = firewall.report()
        refused = next(rule for rule in report.rules if rule.purpose == "ROS master port: no other user")
        assert (report.backend, report.intact, refused.packets) == (backend, True, 2)
        if backend == "nft":
            run_in(protected, "nft flush chain inet rosrv ROSRV-OUT-OUTPUT")
        else:
            run_in(protected, "ip6tables-legacy -D OUTPUT 1")
        report = firewall.report()
        assert not report.intact
        assert "ROS master port: no other user" in {
            rule.purpose for rule in report.rules if not rule.in_force
        }
        firewall.update(settings(port))
        assert firewall.report().intact


def test_auto_selects_a_back_end_that_the_kernel_enforces(
    protected: Host, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert Firewall(protected.namespace).install(settings(11312)) == "nft"
    pretender = tmp_path / "nft"
    pretender.write_text("#!/bin/sh\ncat >/dev/null\necho '{\"nftables\": []}'\n")
    pretender.chmod(0o755)
    Firewall(protected.namespace).remove()
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    firewall = Firewall(protected.namespace)
    with listening(protected) as port:
        assert firewall.install(settings(port)) == "iptables"
        assert "nft: a test port on 127.0.0.1 was reached" in firewall.report().not_used[0]
        assert connect(protected, OTHER, ("127.0.0.1", port)) == ["refused"]
    with pytest.raises(FirewallError, match=r"no firewall works .* nft: a test port"):
        Firewall(protected.namespace, "nft").install(settings(11312))


def test_auto_selects_a_back_end_that_accepts_every_rule(
    protected: Host, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = need_program("nft", "nftables")
    partial = tmp_path / "nft"
    partial.write_text(
        "#!/bin/sh\ncat >$0.$$\n"
        "if grep -q limit $0.$$; then echo 'no such expression: limit' >&2; exit 1; fi\n"
        f'exec {real} "$@" <$0.$$\n'
    )
    partial.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    firewall = Firewall(protected.namespace)
    assert firewall.install(settings(11312)) == "iptables"
    assert "no such expression: limit" in firewall.report().not_used[0]
    assert firewall.report().intact
    assert "table inet rosrv" not in ruleset(protected)


CONFINED = """
import sys
from appliance.network.firewall.firewall import Firewall
from appliance.network.firewall.firewall_rules import FirewallSettings
from appliance.network.namespaces import Namespace, NetworkError
from appliance.network.probe import probe_port
firewall = Firewall(Namespace.own(), sys.argv[2])
try:
    port = int(sys.argv[1])
    print(firewall.install(FirewallSettings(control_uid=61011, rosmaster_uid=61012, rosmaster_port=port)))
    print(probe_port(Namespace.own(), port).closed, firewall.report().intact)
except NetworkError as error:
    print(error)
"""


@pytest.mark.parametrize(
    ("backend", "capabilities", "words"),
    [
        ("nft", "+net_admin,+setuid,+setgid", "nft\nTrue True\n"),
        ("iptables", "+net_admin,+net_raw,+setuid,+setgid", "iptables\nTrue True\n"),
        ("auto", "+net_admin,+setuid,+setgid", "nft\nTrue True\n"),
        ("auto", "+setuid", "the firewall needs CAP_NET_ADMIN"),
    ],
)
def test_the_firewall_needs_only_few_capabilities(
    protected: Host, backend: str, capabilities: str, words: str
) -> None:
    need_program("setpriv", "util-linux")
    with listening(protected) as port:
        process = protected.popen(
            [
                *("setpriv", f"--bounding-set=-all,{capabilities}", f"--inh-caps=-all,{capabilities}"),
                *(sys.executable, "-c", CONFINED, str(port), backend),
            ],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])},
        )
        assert str(process.communicate(timeout=60)[0]).startswith(words)


def test_without_any_back_end_there_is_no_firewall(protected: Host, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nonexistent")
    monkeypatch.setitem(sys.modules, "iptc", None)
    with pytest.raises(FirewallError, match=r"apt install nftables.*package python-iptables"):
        Firewall(protected.namespace).install(settings(11312))


@pytest.mark.parametrize("kind", [NftBackend, IptablesBackend])
def test_the_proof_leaves_nothing(protected: Host, kind: type[NftBackend] | type[IptablesBackend]) -> None:
    before = ruleset(protected)
    prove(kind(protected.namespace), protected.namespace)
    assert ruleset(protected) == before


def test_a_rejected_transaction_keeps_the_old_rules(protected: Host) -> None:
    backend = NftBackend(protected.namespace)
    firewall = Firewall(protected.namespace, "nft")
    firewall.install(settings(11312))
    before = ruleset(protected)
    with pytest.raises(FirewallError, match="nft rejected the rules"):
        backend.install((broken_rule(),))
    assert ruleset(protected) == before


def broken_rule() -> PacketRule:
    return PacketRule(chain=Chain.IN, purpose="x" * 500, verdict=PacketVerdict.DROP)


def test_the_probe_reports_closed_and_open_ports(protected: Host) -> None:
    firewall = Firewall(protected.namespace)
    with listening(protected) as port:
        firewall.install(settings(port))
        result = probe_port(protected.namespace, port)
        assert result.closed
        assert result.listening
        assert [attempt.outcome for attempt in result.attempts] == [ConnectOutcome.REFUSED] * 2
        assert result.listening_outside == ("::",)
        firewall.remove()
        result = probe_port(protected.namespace, port)
        assert not result.closed
        assert [attempt.outcome for attempt in result.attempts] == [ConnectOutcome.REACHED] * 2
    assert not probe_port(protected.namespace, port).listening
    with listening(protected, "127.0.0.1") as port:
        assert probe_port(protected.namespace, port).listening == ("127.0.0.1",)
        assert probe_port(protected.namespace, port).listening_outside == ()


def test_the_probe_runs_as_its_user(protected: Host) -> None:
    firewall = Firewall(protected.namespace)
    with listening(protected) as port:
        for uid, closed in ((0, True), (PROBE_UID, False)):
            firewall.install(FirewallSettings(control_uid=uid, rosmaster_uid=ROSMASTER, rosmaster_port=port))
            assert probe_port(protected.namespace, port).closed is closed


def test_the_probe_refuses_to_be_root(protected: Host) -> None:
    with pytest.raises(ValueError, match="unprivileged"):
        probe_port(protected.namespace, 11312, uid=0)


def test_iptables_rejects_rules_for_address_translation(protected: Host) -> None:
    rule = PacketRule(chain=Chain.NAT, purpose="forward", verdict=PacketVerdict.DNAT, to="10.1.1.1")
    with pytest.raises(BackendMissingError, match="forward"):
        IptablesBackend(protected.namespace).install((rule,))


def test_namespaces_do_not_share_rules(lab: Lab, protected: Host) -> None:
    other = lab.host("other", "10.77.0.20/24")
    Firewall(protected.namespace, "iptables").install(settings(11312))
    Firewall(other.namespace, "iptables").install(settings(11313))
    assert "11313" not in ruleset(protected)
    assert "11312" not in ruleset(other)
    assert (
        "ROSRV"
        not in subprocess.run(
            ["iptables-legacy-save", "-t", "filter"], capture_output=True, text=True, check=True
        ).stdout
    )
