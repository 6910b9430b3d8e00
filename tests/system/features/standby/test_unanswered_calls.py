"""An active appliance whose control is alive and reports, and answers no calls."""

import pytest

from tests.support.features.standby.changed_product import changed_product
from tests.support.features.standby.standby_robot import StandbyRobot
from tests.support.features.standby.standby_site import StandbySite
from tests.support.waiting import eventually

_CHANGES = {
    "control/process.py": (
        "        watched = listener_limits.answering.watch(calls)\n",
        "        async def hanging(request):\n"
        "            while (control.settings.state / 'control' / 'hang').exists():\n"
        "                await asyncio.sleep(0.1)\n"
        "            return await calls(request)\n"
        "        watched = listener_limits.answering.watch(hanging)\n",
    )
}


def test_the_standby_serves_when_no_call_is_answered(
    site: StandbySite, robot: StandbyRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    site.until_both_in_sync()
    active, passive = site.pair()
    with changed_product(_CHANGES) as folder:
        one = site.appliances[passive]
        assert one.process is not None
        one.process.stop()
        with monkeypatch.context() as environment:
            environment.setenv("PYTHONPATH", str(folder))
            site.start(passive)
        site.until_both_in_sync()
        eventually(lambda: one.rosrv("standby", "status"), site.story)
        site.promote(active)
        site.until_taken_over(passive)
        site.until_both_in_sync()
        robot.works()
        (one.state / "control" / "hang").touch()
        site.until_taken_over(active)
        robot.serves_newcomers()
        one.process.stop()
    (one.state / "control" / "hang").unlink()
    site.start(passive)
    site.until_both_in_sync()
    robot.lost_nothing()
