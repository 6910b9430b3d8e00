import json
from collections.abc import Callable
from pathlib import Path

from fleet.tests.support.fleet_site import FleetRobot, FleetSite


def test_the_robots_interventions_are_reported_from_the_collector(
    site: FleetSite, make_robot: Callable[..., FleetRobot], tmp_path: Path
) -> None:
    for name in ("arm1", "arm2"):
        robot = make_robot(name)
        robot.record(30)
        robot.record(
            1, event="monitor disabled", resource="speed", detail={"who": name, "earlier": "enabled"}
        )
        handed = {"earlier": "nobody", "holder": "10.0.0.5", "who": "ann"}
        robot.record(1, event="authority handed over", resource="base", detail=handed)
        robot.push()
    site.indexed()
    report = json.loads(site.run("report", "interventions", "--json").stdout)
    disabled = [one for one in report["interventions"] if one["event"] == "monitor disabled"]
    assert sorted((one["appliance"], one["who"], one["before"]) for one in disabled) == [
        ("arm1", "arm1", "enabled"), ("arm2", "arm2", "enabled"),
    ]  # fmt: skip
    assert {log["name"]: log["last"] >= 30 for log in report["logs"]} == {"arm1": True, "arm2": True}
    page = tmp_path / "report.html"
    assert "arm2" not in site.run("report", "interventions", "--robot", "arm1").stdout
    site.run("report", "interventions", "--robot", "arm?", "--output", str(page))
    assert "2 robots of the collector" in page.read_text()
    assert "arm1  base: 10.0.0.5 since" in site.run("who-drove", "--at", "0s").stdout
    site.run("who-drove", "--at", "2d", status=1)
