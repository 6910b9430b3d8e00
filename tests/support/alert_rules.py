"""Evaluate the shipped alerts of the collector on one scrape after the other, as Prometheus does.

Only comparisons of one metric with a number are evaluated: the rules of rollouts need series of several robots, and
`alerts.tests.yaml` has their cases.
"""

import operator
import re
from collections.abc import Callable, Iterable
from typing import NamedTuple

import yaml
from prometheus_client.core import Metric

from tests.support.sources import ROOT

_COMPARISON = re.compile(r'(\w+)(?:\{(\w+)="([\w-]+)"\})? (==|<|>) ([\d.]+)(?: \* (\d+))?')
_COMPARE: dict[str, Callable[[float, float], bool]] = {
    "==": operator.eq,
    "<": operator.lt,
    ">": operator.gt,
}
_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0}


class Alert(NamedTuple):
    """An alert, and the robot that it names."""

    name: str
    robot: str = ""


class _Rule(NamedTuple):
    name: str
    metric: str
    label: tuple[str, str]
    holds: Callable[[float, float], bool]
    limit: float
    seconds: float


class FleetAlerts:
    def __init__(self) -> None:
        groups = yaml.safe_load((ROOT / "examples" / "prometheus" / "alerts.yaml").read_text())["groups"]
        (rules,) = (group["rules"] for group in groups if group["name"] == "rosrv-fleet")
        self._rules = list(_comparisons(rules))
        self._pending: dict[Alert, float] = {}

    @property
    def names(self) -> set[str]:
        return {rule.name for rule in self._rules}

    def firing(self, now: float, metrics: Iterable[Metric] | None) -> set[Alert]:
        """Return the alerts that fire after a scrape; `metrics` is None if the collector did not answer."""
        found = {rule.name: rule for rule in self._rules}
        samples = [("up", {"job": "rosrv-fleet"}, float(metrics is not None))]
        for family in metrics or ():
            samples += [(sample.name, sample.labels, sample.value) for sample in family.samples]
        true = {
            Alert(rule.name, labels.get("robot", ""))
            for rule in self._rules
            for name, labels, value in samples
            if name == rule.metric
            and (not rule.label[0] or labels.get(rule.label[0]) == rule.label[1])
            and rule.holds(value, rule.limit)
        }
        self._pending = {alert: self._pending.get(alert, now) for alert in true}
        return {alert for alert, since in self._pending.items() if now - since >= found[alert.name].seconds}


def _comparisons(rules: Iterable[dict[str, str]]) -> Iterable[_Rule]:
    for rule in rules:
        match = _COMPARISON.fullmatch(rule["expr"])
        if match is None:
            continue
        metric, label, value, compare, limit, times = match.groups()
        wait = rule.get("for", "0s")
        yield _Rule(
            rule["alert"], metric, (label or "", value or ""), _COMPARE[compare],
            float(limit) * float(times or 1), float(wait[:-1]) * _UNITS[wait[-1]],
        )  # fmt: skip
