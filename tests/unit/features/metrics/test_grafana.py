import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.features.metrics.metric_table import METRICS

ROOT = Path(__file__).parents[4]
DASHBOARD: dict[str, Any] = json.loads((ROOT / "examples/grafana/rosrv.json").read_text())
PANELS = [panel for panel in DASHBOARD["panels"] if panel["type"] != "row"]
KNOWN = {metric.name: metric for metric in METRICS}


def expressions() -> Iterator[tuple[str, str, str]]:
    for panel in PANELS:
        yield from ((panel["title"], target["expr"], target["legendFormat"]) for target in panel["targets"])
    yield from ((one["name"], one["expr"], "") for one in DASHBOARD["annotations"]["list"])


@pytest.mark.parametrize(("panel", "query", "legend"), list(expressions()), ids=lambda text: text[:40])
def test_queried_metrics_exist(panel: str, query: str, legend: str) -> None:
    names = re.findall(r"\brosrv_\w+", query)
    assert names or query.startswith("up{"), panel
    grouped = {
        label for labels in re.findall(r"\bby \(([^)]*)\)", query) for label in re.split(r", *", labels)
    }
    for name in names:
        metric = KNOWN.get(name) or KNOWN.get(re.sub(r"_bucket$", "", name))
        assert metric is not None, name
        assert name.endswith("_bucket") == (metric.kind == "histogram"), name
        assert ("rate(" in query or "increase(" in query) == (metric.kind != "gauge"), f"{panel}: {name}"
        selected = set(re.findall(r'(\w+)="', "".join(re.findall(rf"\b{name}{{([^}}]*)}}", query))))
        assert "instance" in selected, f"{panel} mixes appliances"
        assert (selected | grouped | set(re.findall(r"{{(\w+)}}", legend))) - {"instance", "le"} <= set(
            metric.labels
        )


def test_panels_do_not_overlap() -> None:
    taken: set[tuple[int, int]] = set()
    for panel in DASHBOARD["panels"]:
        place = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert max(x for x, _ in cells) < 24
        assert not cells & taken, panel["title"]
        taken |= cells
    assert len({panel["id"] for panel in DASHBOARD["panels"]}) == len(DASHBOARD["panels"])
    assert all(
        panel["description"].endswith(".") and panel["fieldConfig"]["defaults"]["unit"] for panel in PANELS
    )


# Panel options that Grafana's published schema (`grafana-foundation-sdk`, JSON) requires.
REQUIRED = {
    "stat": {
        "graphMode", "colorMode", "justifyMode", "textMode", "wideLayout", "showPercentChange", "reduceOptions",
        "percentChangeColorMode", "orientation",
    },
    "timeseries": {"legend", "tooltip"},
}  # fmt: skip


@pytest.mark.parametrize("panel", PANELS, ids=lambda panel: str(panel["title"]))
def test_options_are_complete(panel: dict[str, Any]) -> None:
    """Grafana's releases differ in the defaults of missing options."""
    options = panel["options"]
    assert options.keys() == REQUIRED[panel["type"]]
    if "legend" in options:
        assert {"displayMode", "placement", "showLegend", "calcs"} == options["legend"].keys()


def test_the_data_source_is_a_variable() -> None:
    assert [one["name"] for one in DASHBOARD["templating"]["list"]] == ["source", "instance"]
    assert {panel["datasource"]["uid"] for panel in PANELS} == {"${source}"}
