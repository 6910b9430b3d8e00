import contextlib
import errno
import os
import select
import signal
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.features.standby import feature
from appliance.features.standby.lease import WitnessRequest
from appliance.features.standby.process import WitnessChannel
from examples.landshark.lab import Lab
from tests.support.features.standby.witness_site import (
    ADDRESSES,
    AT_ONCE,
    BACKENDS,
    FIXED,
    KEYS,
    MASTER,
    NODE,
    ROBOT,
    THE_PROGRAM,
    WITNESS,
    Site,
    broken_disk,
    forged,
    seconds_until_reset,
)
from tests.support.processes import Process
from tests.support.requirements import need_program, need_root
from tests.support.waiting import eventually


@pytest.fixture(params=BACKENDS)
def site(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Site]:
    need_root()
    with Lab("rosrv-witness") as lab, contextlib.ExitStack() as sockets:
        made = Site(lab, tmp_path, request.param, sockets)
        made.run("begin", "--in-sync", "a,b", "--epoch", "1")
        yield made
        made.stop()


def test_a_new_holder_resets_the_connections_of_the_old_one(site: Site) -> None:
    site.serve()
    a, b = site.peer("a"), site.peer("b")
    epoch = a.granted(1)
    to_master = [site.connect(site.robot, FIXED, MASTER) for _ in range(3)]
    accepted = [site.accepted(site.servers["a"]) for _ in to_master]
    from_a = [site.connect(site.hosts["a"], ROBOT, NODE) for _ in range(3)]
    at_node = [site.accepted(site.node) for _ in from_a]
    for near, far in zip(to_master + at_node, accepted + from_a, strict=True):
        near.sendall(b"x")
        assert far.recv(1) == b"x"
    assert site.refused(site.hosts["b"], ROBOT, NODE)
    assert site.refused(site.robot, ADDRESSES["b"], MASTER)

    assert a.ask("release", epoch).ok
    epoch = b.granted(epoch)
    assert seconds_until_reset(to_master + at_node) < AT_ONCE
    with contextlib.suppress(ConnectionResetError):
        for far in accepted + from_a:
            far.send(b"x")
    assert seconds_until_reset(from_a) < AT_ONCE

    new = site.connect(site.robot, FIXED, MASTER)
    far = site.accepted(site.servers["b"])
    new.sendall(b"y")
    assert far.recv(1) == b"y"
    site.connect(site.hosts["b"], ROBOT, NODE).close()
    assert site.refused(site.hosts["a"], ROBOT, NODE)
    assert site.refused(site.robot, ADDRESSES["a"], MASTER)

    assert b.ask("release", epoch).ok
    a.granted(epoch)
    assert seconds_until_reset([new]) < AT_ONCE
    site.connect(site.robot, FIXED, MASTER).close()
    site.accepted(site.servers["a"])


def test_a_connection_that_the_old_holder_never_answered_is_reset(site: Site) -> None:
    site.serve()
    a, b = site.peer("a"), site.peer("b")
    epoch = a.granted(1)
    site.lab.unplug(site.hosts["a"])
    waiting = [site.connecting(address) for address in (FIXED, ADDRESSES["a"])]
    lost = "oif != lo tcp flags & (syn | ack) == syn drop"
    rules = f"table ip lost {{ chain out {{ type filter hook output priority -50; {lost}; }}; }}"
    with Process(site.robot, ["nft", rules], env=site.environment, label="nft") as process:
        assert process.wait() == 0, process.errors
    b.granted(epoch)
    for one in waiting:
        assert select.select([], [one], [], AT_ONCE)[1]
        assert one.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) == errno.ECONNRESET
    with Process(site.robot, ["nft", "delete table ip lost"], env=site.environment, label="nft") as process:
        process.wait()
    site.connect(site.robot, FIXED, MASTER).close()


def test_a_reboot_shuts_out_both_until_the_holder_renews(site: Site) -> None:
    process = site.serve()
    a, b = site.peer("a"), site.peer("b")
    epoch = a.granted(1)
    process.stop()
    site.connect(site.robot, FIXED, MASTER).close()  # the end of the witness alone changes nothing
    site.run("remove")
    site.lease.write(site.lease.read()._replace(boot="an earlier boot"))
    site.run("shut")
    for name, host in site.hosts.items():
        assert site.refused(host, ROBOT, NODE)
        assert site.refused(site.robot, ADDRESSES[name], MASTER)
    assert site.refused(site.robot, FIXED, MASTER)
    program = site.folder / "witness.py"
    text = program.read_text()
    assert "\nEXPIRY = 1.2" in text
    # The lease still belongs to its holder when the claim arrives, however slow this machine is.
    program.write_text(text.replace("\nEXPIRY = 1.2", "\nEXPIRY = 120.0"))
    site.serve()
    assert "holds the lease for another" in b.ask("claim", epoch).reason
    assert site.refused(site.hosts["a"], ROBOT, NODE)
    assert a.ask("renew", epoch).ok
    site.connect(site.robot, FIXED, MASTER).close()
    assert site.refused(site.hosts["b"], ROBOT, NODE)


def test_a_damaged_lease_shuts_out_both_until_begin(site: Site) -> None:
    (site.folder / "lease").write_bytes(b"damaged")
    process = site.serve()
    assert "witness.py begin" in site.log()
    a = site.peer("a")
    assert "run witness.py begin" in a.ask("claim", 1).reason
    assert site.refused(site.hosts["a"], ROBOT, NODE)
    process.stop()
    site.run("begin", "--in-sync", "a", "--epoch", "7")
    site.serve()
    assert a.granted(7) == 8
    site.connect(site.hosts["a"], ROBOT, NODE).close()


def test_rules_that_another_program_removes_are_written_again(site: Site) -> None:
    site.serve()
    site.peer("a").granted(1)
    if site.backend == "nft":
        changes = [(["nft", "flush", "ruleset"], "")]
    else:
        accept = "*filter\n-I INPUT 1 -j ACCEPT\nCOMMIT\n"
        changes = [(["iptables-restore", "--noflush"], accept), (["iptables-restore"], "*filter\nCOMMIT\n")]
    for command, text in changes:
        assert site.refused(site.hosts["b"], ROBOT, NODE)
        with Process(site.robot, command, env=site.environment, label=command[0]) as process:
            assert process.popen.stdin is not None
            process.popen.stdin.write(text)
            process.popen.stdin.close()
            process.wait()
        eventually(lambda: site.refused(site.hosts["b"], ROBOT, NODE), "b is shut out again")
    assert "another program changed the firewall rules" in site.log()
    site.connect(site.robot, FIXED, MASTER).close()


@pytest.mark.parametrize("script", ["echo no memory >&2; exit 1", "sleep 30"])
def test_a_firewall_program_that_fails_or_hangs_stops_no_renewal(site: Site, script: str) -> None:
    site.serve()
    a, b = site.peer("a"), site.peer("b")
    epoch = a.granted(1)
    with site.firewall_program(script):

        def reported() -> bool:
            answer = a.ask("renew", epoch)
            assert answer.ok, answer.reason
            return "the firewall rules cannot be listed" in answer.trouble

        eventually(reported, site.log)
        site.connect(site.robot, FIXED, MASTER).close()
        assert a.ask("release", epoch).ok
        assert "the firewall rules cannot be listed" in b.ask("claim", epoch).reason
        assert a.ask("renew", epoch).ok
        assert site.lease.read().epoch == epoch
    eventually(lambda: a.ask("renew", epoch).trouble == "", site.log)
    assert "another program changed" not in site.log()
    assert a.ask("release", epoch).ok
    assert b.granted(epoch) == epoch + 1


def test_a_program_that_lists_but_cannot_write_is_reported_before_a_takeover_needs_it(site: Site) -> None:
    site.serve()
    a, b = site.peer("a"), site.peer("b")
    epoch = a.granted(1)
    failing = f'case "$*" in *-f*|*--noflush*) echo no memory >&2; exit 1;; esac\n{THE_PROGRAM}'
    with site.firewall_program(failing):
        eventually(lambda: "takeover cannot be written" in a.ask("renew", epoch).trouble, site.log)
        assert "takeover cannot be written" in b.ask("look", epoch).trouble
        assert a.ask("release", epoch).ok
        assert "takeover cannot be written" in b.ask("claim", epoch).reason
        assert site.lease.read().epoch == epoch
        assert a.ask("renew", epoch).ok
    eventually(lambda: a.ask("renew", epoch).trouble == "", site.log)
    assert a.ask("release", epoch).ok
    assert b.granted(epoch) == epoch + 1


def test_a_disk_that_fails_is_the_reason_of_a_refusal(site: Site) -> None:
    process = site.serve()
    a, b = site.peer("a"), site.peer("b")
    epoch = a.granted(1)
    with broken_disk(process):
        assert "cannot be saved" in a.ask("remove", epoch).reason
        assert a.ask("renew", epoch).in_sync == frozenset("ab")
        assert a.ask("release", epoch).ok
        assert "cannot be saved" in b.ask("claim", epoch).reason
        assert a.ask("renew", epoch).ok
    assert a.ask("remove", epoch).ok
    assert site.lease.read().in_sync == ("a",)


def test_an_attacker_on_the_network_gets_no_lease_and_delays_none(site: Site) -> None:
    site.serve()
    a, b = site.peer("a"), site.peer("b")
    epoch = a.granted(1)
    assert a.ask("renew", epoch).ok
    recorded = [a.sent]
    assert a.ask("remove", epoch).ok
    assert a.ask("add", epoch).ok
    recorded.append(a.sent)
    assert a.ask("remove", epoch).ok
    raw = site.attacker.run(lambda: socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_RAW))
    site.sockets.enter_context(raw)
    wrong_key = WitnessChannel("b", KEYS["a"], "session").write(WitnessRequest("claim", epoch, 1, 0.0))
    for number in range(8_000):
        payload = (recorded[0], recorded[1], wrong_key, os.urandom(100))[number % 4]
        source = (ADDRESSES["a"], ADDRESSES["a"], ADDRESSES["b"], "10.77.0.66")[number % 4]
        raw.sendto(forged(source, payload), (ROBOT, 0))
        if number % 800 == 0:
            assert a.ask("renew", epoch).ok
    assert a.ask("renew", epoch).ok
    assert site.lease.read().in_sync == ("a",)
    assert not b.ask("claim", epoch).ok
    eventually(lambda: "without a valid authentication code" in site.log(), site.log)
    assert len(site.log().splitlines()) < 40
    site.connect(site.robot, FIXED, MASTER).close()


def test_forged_datagrams_take_no_room_from_a_renewal(site: Site) -> None:
    process = site.serve()
    a = site.peer("a")
    epoch = a.granted(1)
    raw = site.attacker.run(lambda: socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_RAW))
    site.sockets.enter_context(raw)
    local = site.robot.run(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    site.sockets.enter_context(local)
    process.popen.send_signal(signal.SIGSTOP)
    try:
        for _ in range(2_000):
            raw.sendto(forged(ADDRESSES["a"], os.urandom(100)), (ROBOT, 0))
            with contextlib.suppress(PermissionError):  # by the firewall
                local.sendto(os.urandom(100), (ROBOT, WITNESS))
        renewal = a.channel.write(WitnessRequest("renew", epoch, 1, 0.0))
        a.socket.send(renewal)
    finally:
        process.popen.send_signal(signal.SIGCONT)
    a.socket.settimeout(AT_ONCE)
    found = a.channel.read(a.socket.recv(1024))
    assert found is not None
    assert found[1].ok


def test_the_units_start_the_witness_and_shut_out_both_before_the_network() -> None:
    folder = Path(feature.__file__).parent
    units = sorted((folder / "kit_files").glob("*.service"))
    command = [need_program("systemd-analyze", "systemd"), "verify", *map(str, units)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    following, shutting, serving = (unit.read_text() for unit in units)
    assert "ExecStart=/usr/bin/python3 -I /etc/rosrv/witness.py follow\n" in following
    assert "ExecStart=/usr/bin/python3 -I /etc/rosrv/witness.py serve\n" in serving
    assert "ExecStart=/usr/bin/python3 -I /etc/rosrv/witness.py shut\n" in shutting
    assert "Before=network-pre.target" in shutting and "DefaultDependencies=no" in shutting
