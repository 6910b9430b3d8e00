"""A follower with the kernel's firewall and real connections admits the appliance that the witness admits, or none."""

import contextlib
import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.features.standby.lease import WitnessRequest
from appliance.features.standby.process import WitnessChannel
from appliance.features.standby.witness.protocol import REQUEST, seal
from examples.landshark.lab import Lab
from tests.support.features.standby.witness_site import (
    ADDRESSES,
    BACKENDS,
    FIXED,
    FOLLOWER,
    FOLLOWER_KEY,
    MASTER,
    NODE,
    ROBOT,
    THE_PROGRAM,
    WITNESS,
    Peer,
    Site,
    broken_disk,
    forged,
    seconds_until_reset,
)
from tests.support.processes import LIMIT
from tests.support.requirements import need_root
from tests.support.waiting import eventually


class Renewing:
    def __init__(self, peer: Peer, epoch: int) -> None:
        self._peer = peer
        self.epoch = epoch
        self.renewed = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._renew)
        self._thread.start()

    def _renew(self) -> None:
        while not self._ended.wait(0.2):
            self.renewed += self._peer.ask("renew", self.epoch).ok

    def end(self) -> None:
        self._ended.set()
        self._thread.join()


@pytest.fixture(params=BACKENDS)
def site(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Site]:
    need_root()
    with Lab("rosrv-follower") as lab, contextlib.ExitStack() as sockets:
        made = Site(lab, tmp_path, request.param, sockets)
        made.run("begin", "--in-sync", "a,b", "--epoch", "1")
        made.serve()
        yield made
        made.stop()


@contextlib.contextmanager
def held(site: Site, name: str, epoch: int) -> Iterator[Renewing]:
    peer = site.peer(name)
    renewing = Renewing(peer, peer.granted(epoch))
    try:
        yield renewing
    finally:
        renewing.end()


def connected(site: Site) -> socket.socket | None:
    try:
        return site.connect(site.follower, FIXED, MASTER)
    except OSError:
        return None


def reaches(site: Site, name: str) -> bool:
    try:
        site.connect(site.follower, FIXED, MASTER, 1).close()
    except OSError:
        return False
    site.accepted(site.servers[name])
    return True


def test_a_follower_changes_over_with_the_robot(site: Site) -> None:
    site.follow()
    assert site.refused(site.follower, FIXED, MASTER)
    with held(site, "a", 1) as first:
        eventually(lambda: reaches(site, "a"), "the follower admits a")
        idle = eventually(lambda: connected(site), "the follower is admitted")
        site.accepted(site.servers["a"])
        assert site.refused(site.follower, ADDRESSES["b"], MASTER)
        first.end()
        with held(site, "b", first.epoch):
            seconds_until_reset([idle])
            eventually(lambda: reaches(site, "b"), "the follower admits b")
            assert site.refused(site.follower, ADDRESSES["a"], MASTER)


@pytest.mark.parametrize("seconds", [0.4, 1.1])
def test_a_slow_firewall_interrupts_nothing_while_the_witness_answers(site: Site, seconds: float) -> None:
    """`seconds` is the time of each run of the program; a change of the rules needs one to three."""
    with held(site, "a", 1) as first:
        with site.firewall_program(f"sleep {seconds}\n{THE_PROGRAM}"):
            following = site.follow()
            eventually(lambda: reaches(site, "a"), lambda: f"the follower admits a: {following.errors}")
            renewed = first.renewed
            eventually(lambda: first.renewed > renewed + 50, lambda: "the lease is renewed")
            assert "no appliance" not in "\n".join(following.errors[2:]), following.errors
            assert reaches(site, "a")
        first.end()
        with held(site, "b", first.epoch):
            eventually(lambda: reaches(site, "b"), lambda: f"the follower admits b: {following.errors}")
    assert "another program" not in "\n".join(following.errors) + site.log()


def test_without_the_witness_a_follower_shuts_out_both(site: Site) -> None:
    following = site.follow()
    with held(site, "a", 1) as holder:
        eventually(lambda: reaches(site, "a"), "the follower admits a")
        idle = eventually(lambda: connected(site), "the follower is admitted")
        assert site.process is not None
        holder.end()
        site.process.stop()
        seconds_until_reset([idle])
        for name in ADDRESSES:
            assert site.refused(site.follower, ADDRESSES[name], MASTER)
        # The end of the witness alone changes nothing on the robot.
        site.connect(site.robot, FIXED, MASTER).close()
        site.accepted(site.servers["a"])
        site.serve()
        again = Renewing(site.peer("a"), holder.epoch)
        try:
            eventually(lambda: reaches(site, "a"), lambda: f"admitted again: {following.errors}")
        finally:
            again.end()


def test_a_follower_whose_disk_fails_shuts_out_both_until_it_works(site: Site) -> None:
    following = site.follow()
    with held(site, "a", 1) as first:
        eventually(lambda: reaches(site, "a"), "the follower admits a")
        with broken_disk(following):
            assert reaches(site, "a")
            first.end()
            with held(site, "b", first.epoch):
                eventually(
                    lambda: "cannot be saved" in "\n".join(following.errors), lambda: str(following.errors)
                )
                assert not reaches(site, "b")
        with held(site, "b", first.epoch + 1):
            eventually(lambda: reaches(site, "b"), lambda: str(following.errors))
    assert following.popen.poll() is None


def test_a_restored_witness_is_not_followed(site: Site) -> None:
    following = site.follow()
    with held(site, "a", 1):
        eventually(lambda: reaches(site, "a"), "the follower admits a")
    following.stop()
    assert site.process is not None
    site.process.stop()
    site.lease.write(site.lease.read()._replace(epoch=1, holder="b"))
    site.serve()
    site.connect(site.robot, ADDRESSES["b"], MASTER).close()
    following = site.follow()
    eventually(
        lambda: "the witness knows only epoch 1" in "\n".join(following.errors), lambda: str(following.errors)
    )
    for name in ADDRESSES:
        assert site.refused(site.follower, ADDRESSES[name], MASTER)


def test_an_attacker_gains_nothing_from_a_followers_datagrams(site: Site) -> None:
    following = site.follow()
    with held(site, "a", 1) as holder:
        eventually(lambda: reaches(site, "a"), "the follower admits a")
        raw = site.attacker.run(lambda: socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_RAW))
        site.sockets.enter_context(raw)
        body = {"boot": "", "session": "x", "number": 1, "epoch": holder.epoch}
        lies = [
            seal(REQUEST, "arm", FOLLOWER_KEY, body | {"do": "claim"}),
            seal(REQUEST, "b", FOLLOWER_KEY, body | {"do": "claim"}),
            seal(REQUEST, "arm", FOLLOWER_KEY, body | {"do": "look"}),
            WitnessChannel("b", FOLLOWER_KEY, "session").write(WitnessRequest("claim", holder.epoch, 1, 0.0)),
            os.urandom(200),
        ]
        for number in range(10_000):
            raw.sendto(forged(FOLLOWER, lies[number % len(lies)]), (ROBOT, 0))
        record = site.lease.read()
        assert (record.holder, record.epoch) == ("a", holder.epoch)
        renewed = holder.renewed
        eventually(lambda: holder.renewed > renewed, site.log)
        eventually(lambda: reaches(site, "a"), lambda: f"the follower goes on: {following.errors}")


def test_other_addresses_do_not_reach_the_witness(site: Site) -> None:
    attacker = site.attacker.run(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    follower = site.follower.run(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    body = {"boot": "", "session": "x", "number": 1, "epoch": 1, "do": "look"}
    for asking, seconds in ((attacker, 1), (follower, LIMIT)):
        site.sockets.enter_context(asking)
        asking.settimeout(seconds)
        asking.sendto(seal(REQUEST, "arm", FOLLOWER_KEY, body), (ROBOT, WITNESS))
    assert follower.recv(1024)
    with pytest.raises(TimeoutError):
        attacker.recv(1024)
    assert site.refused(site.hosts["a"], ROBOT, NODE)
