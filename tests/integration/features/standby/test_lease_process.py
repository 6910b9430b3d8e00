"""The process `lease` with real sockets, and with a witness and another appliance that answer, are silent, or lie."""

import asyncio
import contextlib
import os
import select
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.base import clock
from appliance.channel import messages
from appliance.channel.channel import Channel, ChannelClosedError
from appliance.features.standby import lease_link
from appliance.features.standby.lease import ClaimPromise, PromiseRequest
from appliance.features.standby.membership import Membership
from appliance.features.standby.process import OBSTACLE_SECONDS, LeaseProcess, PeerChannel
from appliance.features.standby.witness.lease_file import LeaseRecord
from appliance.features.standby.witness.lease_rules import Witness
from appliance.features.standby.witness.protocol import EXPIRY
from appliance.features.standby.witness.request_gate import WitnessGate
from appliance.features.standby.witness.settings import AppliancePeer
from examples.landshark.lab import Host, Lab
from tests.support.requirements import need_root
from tests.support.waiting import eventually

ROBOT, OWN, OTHER, STRANGER = "10.78.0.10", "10.78.0.2", "10.78.0.3", "10.78.0.66"
KEY, PEER_KEY = b"\xaa" * 32, b"\xcc" * 32
MEMBERSHIP = Membership(
    name="a", other="b", address=OWN, other_address=OTHER, fixed="10.78.0.100", witness=ROBOT, witness_port=7411,
    witness_key=KEY.hex(), peer_key=PEER_KEY.hex(), certificate="", key="", other_certificate="",
)  # fmt: skip


class Site:
    def __init__(self, lab: Lab, folder: Path) -> None:
        self.hosts: dict[str, Host] = {
            address: lab.host(name, f"{address}/24")
            for name, address in (("robot", ROBOT), ("own", OWN), ("other", OTHER), ("stranger", STRANGER))
        }
        self.epoch = folder / "epoch"
        self.witness = self.bound(ROBOT, 7411)
        self.peer = self.bound(OTHER, MEMBERSHIP.port)
        here, there = socket.socketpair()
        self.supervisor = Channel(here, messages.Lifeline)
        self._lifeline = there
        self.reports: list[Any] = []
        self.failures: list[BaseException] = []
        self._thread = threading.Thread(target=lambda: self.hosts[OWN].run(self._run))
        self.record = LeaseRecord(1, "", ("a", "b"), "boot")
        self.rules = Witness(
            record=self.record, save=self._save, admit=lambda _: None, boot="boot", clock=clock.since_boot
        )
        peers = {"a": AppliancePeer(OWN, KEY), "b": AppliancePeer(OTHER, b"\xbb" * 32)}
        self.gate = WitnessGate(self.rules, peers, "nonce")

    def bound(self, address: str, port: int) -> socket.socket:
        sock = self.hosts[address].run(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        sock.bind((address, port))
        sock.settimeout(0.05)
        return sock

    def _save(self, record: LeaseRecord) -> None:
        self.record = record

    def _run(self) -> None:
        async def work() -> None:
            process: Any = LeaseProcess.open(MEMBERSHIP, self._lifeline.detach(), self.epoch)
            try:
                await process.run()
            finally:  # a real process ends here
                process.child.close()
                process.supervisor.close()

        try:
            asyncio.run(work())
        except (OSError, ValueError) as error:
            self.failures.append(error)

    def start(self) -> None:
        self._thread.start()
        ours, theirs = socket.socketpair()
        self.control = Channel(ours, lease_link.LeaseLink)
        self.supervisor.send(messages.LinkOpened("control", 0), (theirs.fileno(),))
        theirs.close()
        self.control.send(lease_link.ControlPresent())

    def serve(self, times: int = 1) -> None:
        with contextlib.suppress(TimeoutError):
            while times > 0 or select.select([self.witness], [], [], 0)[0]:
                times -= 1
                datagram, address = self.witness.recvfrom(2048)
                answer = self.gate.answer(datagram, address[0])
                if answer is not None:
                    self.witness.sendto(answer, address)

    def until(self, condition: Callable[[], bool], *, serving: bool = True) -> None:
        def met() -> bool:
            if serving:
                self.serve()
            self.read()
            return condition()

        eventually(met, lambda: f"{self.reports[-10:]} {self.failures}")

    def read(self) -> None:
        with contextlib.suppress(ChannelClosedError):
            self.reports += [
                message
                for message, _ in self.supervisor.receive()
                if isinstance(message, messages.LeaseHeld | messages.LeaseEnded)
            ]

    def held(self) -> bool:
        return bool(self.reports) and isinstance(self.reports[-1], messages.LeaseHeld)

    def close(self) -> None:
        self.supervisor.close()
        if self._thread.is_alive():
            self._thread.join(30)
        with contextlib.suppress(AttributeError):
            self.control.close()
        for sock in (self.witness, self.peer, self._lifeline):
            sock.close()
        assert not self._thread.is_alive()


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    need_root()
    with Lab("rosrv-lease") as lab:
        made = Site(lab, tmp_path)
        try:
            yield made
        finally:
            made.close()


def test_a_grant_is_reported_with_its_end_and_its_epoch_is_on_the_disk(site: Site) -> None:
    site.start()
    site.until(site.held)
    assert site.reports[-1].epoch == site.record.epoch == 2
    assert int(site.epoch.read_text()) == 2
    assert site.reports[-1].until <= clock.since_boot() + 0.8 * 1.2
    first = site.reports[-1].until
    site.until(lambda: site.held() and site.reports[-1].until > first)


def test_without_answers_no_extension_follows(site: Site) -> None:
    """The last report ends in less than an expiry, so the supervisor stops the service without any message.

    A renewal in the same epoch may follow, but not once the other appliance has had the time to claim.
    """
    site.start()
    site.until(site.held)
    site.until(lambda: not site.held(), serving=False)
    held = [report.until for report in site.reports if isinstance(report, messages.LeaseHeld)]
    assert max(held) <= clock.since_boot()
    assert site.reports[-1].renewable
    site.until(lambda: not site.reports[-1].renewable, serving=False)


def test_garbage_and_forgeries_change_nothing(site: Site) -> None:
    site.start()
    site.until(site.held)
    stranger = site.bound(STRANGER, 0)
    forged = PeerChannel("b", "a", b"\xdd" * 32).write(PromiseRequest(99, "s", 1))
    genuine = PeerChannel("b", "a", PEER_KEY).write(PromiseRequest(99, "s", 1))
    with stranger:
        for datagram in (b"", b"\x01b", os.urandom(1000), forged, genuine):
            stranger.sendto(datagram, (OWN, MEMBERSHIP.port))
    for datagram in (b"", os.urandom(1000), forged):
        site.peer.sendto(datagram, (OWN, MEMBERSHIP.port))
        site.witness.sendto(datagram, (OWN, MEMBERSHIP.port))
    before = site.reports[-1].until
    site.until(lambda: site.held() and site.reports[-1].until > before)
    assert int(site.epoch.read_text()) == 2


def test_a_greater_epoch_of_the_other_appliance_ends_its_own(site: Site) -> None:
    site.start()
    site.until(site.held)
    site.until(lambda: not site.held(), serving=False)
    channel = PeerChannel("b", "a", PEER_KEY)
    site.peer.sendto(channel.write(PromiseRequest(9, "theirs", 1)), (OWN, MEMBERSHIP.port))
    site.until(
        lambda: site.reports[-1] == messages.LeaseEnded() and int(site.epoch.read_text()) == 9,
        serving=False,
    )


def test_a_damaged_epoch_file_keeps_it_passive(site: Site) -> None:
    site.epoch.write_text("7x\n")
    site.start()
    eventually(lambda: site.failures, "the reason")
    assert "does not contain an epoch" in str(site.failures[0])
    site.read()
    assert not site.reports


def test_a_smaller_epoch_of_the_witness_grants_nothing(site: Site) -> None:
    site.epoch.write_text("40\n")
    site.start()
    for _ in range(30):
        site.serve()
    site.read()
    assert not site.held() and site.record.epoch == 1
    state = [message for message, _ in site.control.receive() if isinstance(message, lease_link.LeaseState)][
        -1
    ]
    assert (
        "the witness on the robot refuses this appliance: the witness knows only" in state.takeover_obstacle
    )
    assert (state.holder, state.in_sync) == ("", False)


def test_it_claims_only_while_control_is_ready(site: Site) -> None:
    site.start()
    site.control.send(lease_link.ControlUnready())
    later = clock.since_boot() + 3 * EXPIRY
    site.until(lambda: clock.since_boot() > later)
    assert not site.held() and site.record.epoch == 1
    site.control.send(lease_link.ControlPresent())
    site.until(site.held)
    assert site.record.epoch == 2


def test_a_holder_that_does_not_serve_gives_the_lease_away(site: Site) -> None:
    site.start()
    site.until(site.held)
    theirs, able = PeerChannel("b", "a", PEER_KEY), [False]

    def given_away() -> bool:
        site.control.send(lease_link.ControlServes("the disk is full", keeps_state=True))
        with contextlib.suppress(TimeoutError):
            asked = theirs.read(site.peer.recv(2048))
            if isinstance(asked, PromiseRequest):
                promise = ClaimPromise(asked.epoch, asked.session, asked.number, able[0])
                site.peer.sendto(theirs.write(promise), (OWN, MEMBERSHIP.port))
        return not site.held()

    later = clock.since_boot() + 3 * OBSTACLE_SECONDS
    site.until(lambda: given_away() or clock.since_boot() > later)
    assert site.held()
    able[0] = True
    site.until(given_away)
    site.until(lambda: not site.rules.left())
