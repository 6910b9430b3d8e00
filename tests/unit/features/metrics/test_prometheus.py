import re
from pathlib import Path
from typing import Any

import yaml

from appliance.audit.log.events import EVENTS
from appliance.features.metrics.metric_table import METRICS

FOLDER = Path(__file__).parents[4] / "examples" / "prometheus"
# tests/system/fleet/test_bundles.py compares the page with what the collector serves.
COLLECTORS = set(
    re.findall(r"`(rosrv_fleet_\w+)`", (FOLDER.parents[1] / "docs/reference/fleet.md").read_text())
)


def rules() -> list[dict[str, Any]]:
    groups = yaml.safe_load((FOLDER / "alerts.yaml").read_text())["groups"]
    return [rule for group in groups for rule in group["rules"]]


def test_metrics_of_alerts_exist() -> None:
    known = {metric.name: metric for metric in METRICS}
    for rule in rules():
        names = re.findall(r"\brosrv_(?!fleet_)\w+", rule["expr"].replace('job="rosrv"', ""))
        collectors = re.findall(r"\brosrv_fleet_\w+", rule["expr"])
        assert names or collectors or "up{" in rule["expr"], rule["alert"]
        assert set(collectors) <= COLLECTORS, rule["alert"]
        for name in names:
            metric = known.get(name) or known.get(re.sub(r"_(bucket|sum|count)$", "", name))
            assert metric is not None, f"{rule['alert']}: {name} is not measured"
            for labels in re.findall(rf"\b{name}{{([^}}]*)}}", rule["expr"]):
                given = set(re.findall(r"(\w+)=", labels))
                assert given <= set(metric.labels), f"{rule['alert']}: {given}"


def test_every_alert_has_an_explanation_and_advice() -> None:
    for rule in rules():
        notes = rule["annotations"]
        assert set(notes) == {"summary", "what_to_do"}, rule["alert"]
        assert all(len(text) > 20 for text in notes.values()), rule["alert"]
        assert rule["labels"]["severity"] in {"critical", "warning", "info"}
        for event in re.findall(r"--event '([^']+)'", notes["what_to_do"]):
            assert event in EVENTS, f"{rule['alert']}: {event}"


def test_every_alert_is_tested() -> None:
    cases = "".join(path.read_text() for path in FOLDER.glob("alerts*.tests.yaml"))
    assert [rule["alert"] for rule in rules() if rule["alert"] not in cases] == []


def test_the_page_names_every_alert() -> None:
    page = (FOLDER.parents[1] / "docs" / "reference" / "metrics.md").read_text()
    assert [rule["alert"] for rule in rules() if rule["alert"] not in page] == []
