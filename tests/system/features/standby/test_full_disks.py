from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.features.standby.membership import load_membership, path_of, save_membership
from examples.landshark.lab import Lab
from tests.support.features.standby.standby_robot import StandbyRobot
from tests.support.features.standby.standby_site import ADDRESSES, ROBOT, StandbySite
from tests.support.nodes import has_ros
from tests.support.requirements import need_program, need_root, needs
from tests.support.small_disk import filled, small_disk
from tests.support.waiting import eventually


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StandbySite]:
    need_root()
    need_program("nft", "nftables")
    needs(has_ros(), "ROS 1 and g++ (run `make setup`)")
    home: Path = tmp_path_factory.mktemp("disks")
    with (
        small_disk(home / "robot", "1m") as disk,
        Lab("rosrv-disks") as lab,
        StandbySite(lab, home, lease_folder=disk) as made,
    ):
        state = made.appliances["a"].state
        member = load_membership(path_of(state))
        assert member is not None
        with small_disk(state, "200m", "mode=0711"):
            save_membership(path_of(state), member)
            made.start_witness()
            made.start("a")
            made.until_active("a")
            made.start("b")
            made.until_both_in_sync()
            yield made


def until_able(site: StandbySite) -> None:
    for one in site.appliances.values():
        eventually(lambda one=one: one.rosrv("standby", "status"), site.story)  # type: ignore[misc]  # mypy infers no type for a lambda's default


def test_a_standby_that_the_witness_does_not_answer(site: StandbySite) -> None:
    until_able(site)
    with site.without_link((ADDRESSES["b"], ROBOT)):
        for one in site.appliances.values():
            eventually(
                lambda one=one: one.rosrv("standby", "status", check=False).returncode == 1,  # type: ignore[misc]  # as above
                site.story,
            )
            done = one.rosrv("standby", "promote", check=False)
            assert (done.returncode, "does not answer" in done.stderr) == (1, True), done
    assert site.lease.read().epoch == 2


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


def test_a_full_disk_of_the_active_appliance(site: StandbySite, robot: StandbyRobot) -> None:
    until_able(site)
    site.promote("b")
    site.until_taken_over("a")
    site.until_active("a")
    until_able(site)
    with filled(site.appliances["a"].state):
        site.until_taken_over("b")
        robot.serves_newcomers()
    until_able(site)
