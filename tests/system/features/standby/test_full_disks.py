import os
import re
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from appliance.features.standby.membership import load_membership, path_of, save_membership
from appliance.features.standby.witness.lease_file import LeaseRecord
from examples.landshark.lab import Lab
from tests.support.appliance import Appliance
from tests.support.features.standby.standby_robot import StandbyRobot
from tests.support.features.standby.standby_site import ADDRESSES, ROBOT, StandbySite
from tests.support.nodes import need_ros
from tests.support.processes import Process
from tests.support.requirements import need_program, need_root
from tests.support.small_disk import filled, small_disk
from tests.support.waiting import eventually

_LITTLE = 3 << 20  # bytes


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StandbySite]:
    need_root()
    need_program("nft", "nftables")
    need_ros()
    home: Path = tmp_path_factory.mktemp("disks")
    with (
        small_disk(home / "robot", "1m") as disk,
        Lab("rosrv-disks") as lab,
        StandbySite(lab, home, lease_folder=disk) as made,
        ExitStack() as disks,
    ):
        for appliance in made.appliances.values():
            member = load_membership(path_of(appliance.state))
            assert member is not None
            disks.enter_context(small_disk(appliance.state, "200m", "mode=0711"))
            save_membership(path_of(appliance.state), member)
        made.begin()
        yield made


def until_able(site: StandbySite) -> None:
    for appliance in site.appliances.values():
        eventually(lambda one=appliance: one.rosrv("standby", "status"), site.story)  # type: ignore[misc]  # mypy infers no type for a lambda's default


def test_a_standby_that_the_witness_does_not_answer(site: StandbySite) -> None:
    until_able(site)
    with site.without_link((ADDRESSES["b"], ROBOT)):
        for appliance in site.appliances.values():
            eventually(
                lambda one=appliance: one.rosrv("standby", "status", check=False).returncode == 1,  # type: ignore[misc]  # mypy infers no type for a lambda's default
                site.story,
            )
            done = appliance.rosrv("standby", "switch", check=False)
            assert (done.returncode, "does not answer" in done.stderr) == (1, True), done
    assert site.lease.read().epoch == 2


def test_an_older_lease_on_a_restored_disk_of_the_robot(site: StandbySite, robot: StandbyRobot) -> None:
    """With it, the robot admits neither appliance, so a switchover would end the service."""
    until_able(site)
    epoch = site.lease.read().epoch
    site.stop_witness()
    site.lease.write(LeaseRecord(epoch - 1, site.holder(), ("a", "b"), ""))
    site.boot_robot()
    refuse(site, f"the witness knows only epoch {epoch - 1}: run witness.py begin")
    site.stop_witness()
    words = site.command("begin", "--in-sync", "a,b", "--epoch", str(epoch + 1))
    with Process(site.robot, words, env=dict(os.environ), label="begin") as begun:
        assert begun.wait() == 0, begun.story()
    site.start_witness()
    until_able(site)
    assert site.lease.read().epoch == epoch + 2
    robot.serves_newcomers()


def test_an_epoch_that_was_never_granted_is_repaired(site: StandbySite, robot: StandbyRobot) -> None:
    until_able(site)
    epoch = site.lease.read().epoch
    for name in reversed(site.pair()):  # the standby could take over from an active one that stops
        one = site.appliances[name]
        assert one.process is not None
        one.process.stop()
        (one.state / "lease" / "epoch").write_text(f"{epoch + 7}\n")
    for name, one in site.appliances.items():
        site.start(name)
        eventually(
            lambda one=one: f"knows only epoch {epoch}" in one.rosrv("standby", "status", check=False).stdout,  # type: ignore[misc]  # mypy infers no type for a lambda's default
            site.story,
        )
    for one in site.appliances.values():
        assert one.process is not None
        one.process.stop()
        assert f"Epoch {epoch + 7} is forgotten" in one.rosrv("standby", "repair").stdout
    for name in site.appliances:
        site.start(name)
    until_able(site)
    assert site.lease.read().epoch == epoch + 1
    robot.serves_newcomers()


def test_a_full_disk_of_the_robot(site: StandbySite, robot: StandbyRobot) -> None:
    until_able(site)
    with filled(site.home / "robot"):
        site.cut("a")
        site.until_taken_over("b")
        robot.cut()
        robot.boot()
        assert site.holder() == "b"
    site.restore("a")
    site.until_both_in_sync()


def test_two_nearly_full_disks(site: StandbySite, robot: StandbyRobot) -> None:
    """The lease does not go to and fro: while neither can serve, and after it has gone both ways.

    The rest may be written before the next look at the disk: then it is full, and called so.
    """

    def reports(name: str, pattern: str) -> None:
        def told() -> bool:
            done = site.appliances[name].rosrv("standby", "status", check=False)
            return done.returncode == 1 and re.search(pattern, " ".join(done.stdout.split())) is not None

        eventually(told, site.story)

    until_able(site)
    epoch, (first, second) = site.lease.read().epoch, site.pair()
    states = {name: appliance.state for name, appliance in site.appliances.items()}
    with filled(states[second], _LITTLE):
        reports(first, "are free on its disk|disk is full")
        with filled(states[first], _LITTLE):
            for name in (first, second):
                reports(name, f"does not serve the robot: .*{states[first]}")
        assert site.lease.read().epoch == epoch
    until_able(site)
    with filled(states[first], _LITTLE):
        site.until_taken_over(second)
        robot.serves_newcomers()
    until_able(site)
    with filled(states[second], _LITTLE):
        site.until_taken_over(first)
    with filled(states[first], _LITTLE):
        for name in (first, second):
            reports(name, "it keeps the lease: it gave the lease away before")
        assert site.lease.read().epoch == epoch + 2
    until_able(site)
    robot.serves_newcomers()


def refuse(site: StandbySite, words: str) -> None:
    """Require that both appliances report these words, and refuse to switch over with them."""
    epoch = site.lease.read().epoch
    for one in site.appliances.values():

        def reports(one: Appliance = one) -> bool:
            done = one.rosrv("standby", "status", check=False)
            return done.returncode == 1 and words in " ".join(done.stdout.split())

        eventually(reports, site.story)
    for appliance in site.appliances.values():
        done = appliance.rosrv("standby", "switch", check=False)
        assert (done.returncode, words in done.stderr) == (1, True), done
    assert site.lease.read().epoch == epoch


def test_an_audit_log_that_the_standby_could_not_write(site: StandbySite) -> None:
    """With it, an active appliance grants nothing, and gives the lease away."""
    until_able(site)
    standby, other = site.pair()
    site.promote(standby)
    site.until_taken_over(other)
    site.until_active(other)
    until_able(site)
    log = site.appliances[standby].state / "control" / "audit.db"
    moved = log.rename(log.with_name("moved"))
    log.mkdir()
    try:
        refuse(site, "the audit log cannot be written")
    finally:
        log.rmdir()
        moved.rename(log)
    until_able(site)
