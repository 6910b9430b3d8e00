import os
from pathlib import Path

import pytest
from rosrv_fleet.enrolment import EnrolmentError
from rosrv_fleet.robots import Robots

from appliance.base.clock import using, wall
from appliance.features.fleet import verbs
from appliance.features.fleet.connection import CollectorError, robot_context
from appliance.formats.fleet_membership import Invitation
from appliance.signing.own_certificate import make_own_certificate
from appliance.supervisor.users import Account
from fleet.tests.support.enrolled_robots import JoiningAppliance
from tests.support.virtual_clock import VirtualClock

YEAR = 365 * 86_400.0


def at(years: float) -> VirtualClock:
    return VirtualClock(wall=wall() + years * YEAR)


@pytest.mark.parametrize("years", [-3, 3], ids=["behind", "ahead"])
def test_a_join_with_a_wrong_clock_is_refused(years: float, tmp_path: Path) -> None:
    """The collector could not accept the certificate later. The error has its times and the collector's clock."""
    robots = Robots(tmp_path / "robots")
    with using(at(years)):
        robot = JoiningAppliance()
    with pytest.raises(EnrolmentError, match=r"valid from .* the clock of the collector shows 20"):
        robot.join(robots)
    assert robots.all() == {}


def test_a_join_after_the_clock_was_corrected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verbs, "account_of", lambda user: Account(user, os.getuid(), os.getgid()))
    invitation = Invitation(
        robot="arm7", collector="https://192.0.2.9:8444", authority="", receipt_key="", expires=1.0,
        token=f"rosrv-join_{'A' * 43}",
    )  # fmt: skip
    with using(at(3)):
        wrong = verbs.prepare_membership(tmp_path / "joined.new", invitation)
    first, second = (verbs.prepare_membership(tmp_path / "joined.new", invitation) for _ in range(2))
    assert first == second != wrong


def test_a_robot_names_its_clock(tmp_path: Path) -> None:
    """With a clock of 1970 it does not even connect, because TLS would only report an invalid certificate."""
    key, certificate = make_own_certificate("arm7", 825)
    files = tmp_path / "ca.pem", tmp_path / "robot.pem", tmp_path / "robot.key"
    for file, text in zip(files, (certificate, certificate, key), strict=True):
        file.write_bytes(text)
    robot_context(*files)
    with (
        using(VirtualClock(wall=600.0)),
        pytest.raises(
            CollectorError, match=r"the clock of this machine shows 1970-01-01 00:10 UTC: correct the clock"
        ),
    ):
        robot_context(*files)
    with using(at(3)), pytest.raises(CollectorError, match="or join again with a new invitation"):
        robot_context(*files)
