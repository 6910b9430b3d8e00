import json

from tests.support.appliance import Appliance
from tests.support.features.standby.standby_robot import StandbyRobot
from tests.support.features.standby.standby_site import ADDRESSES, StandbySite
from tests.support.waiting import eventually

LACKS = "so it cannot take over; check the disk and the load of its machine"


def fails(appliance: Appliance) -> str:
    done = appliance.rosrv("standby", "status", check=False)
    return " ".join(done.stdout.split()) if done.returncode == 1 else ""


def test_a_standby_that_lacks_changes_is_reported_by_both_and_refuses_the_order(
    site: StandbySite, robot: StandbyRobot
) -> None:
    site.until_both_in_sync()
    active, _passive = site.pair()
    with site.slow_link(50):
        robot.parameters.send(json.dumps({"do": "set", "key": "/slow", "value": "x" * 400_000}))
        eventually(lambda: site.in_sync() == {active}, site.story)
        for one in site.appliances.values():
            eventually(lambda one=one: LACKS in fails(one), site.story)  # type: ignore[misc]  # mypy infers no type for a lambda's default
        for appliance in site.appliances.values():
            done = appliance.rosrv("standby", "switch", check=False)
            assert (done.returncode, LACKS in done.stderr) == (1, True), done
        assert site.in_sync() == {active}
    site.until_both_in_sync()
    robot.lost_nothing()


def test_a_cut_between_the_appliances_is_not_reported_as_a_refusal(site: StandbySite) -> None:
    """The standby claims again and again, as it must, and the witness does not grant it."""
    site.until_both_in_sync()
    active, passive = site.pair()
    with site.without_link((ADDRESSES["a"], ADDRESSES["b"])):
        site.appliances[active].rosrv("host", "block", "10.79.0.99")  # the standby lacks this change
        eventually(lambda: site.in_sync() == {active}, site.story)
        for name in (passive, active):
            eventually(lambda name=name: fails(site.appliances[name]), site.story)  # type: ignore[misc]  # mypy infers no type for a lambda's default
            assert "refuses" not in fails(site.appliances[name])
    site.until_both_in_sync()
