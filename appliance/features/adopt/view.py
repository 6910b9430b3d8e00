"""Show the adoption in the status and the alarms."""

from collections.abc import Iterator
from typing import Any

from appliance.base.counted import counted
from appliance.base.metric import gauge
from appliance.features.adopt.adopt_answers import AdoptState
from appliance.features.view import AlarmKind, FeatureView, Samples, StateView, Trouble

_METRICS = (
    gauge(
        "rosrv_adopted",
        "1 while the robot's nodes use the appliance in place of their own master, 0 while they should and do not;"
        " absent without `rosrv adopt`",
    ),
)


def _alarms(state: AdoptState) -> Iterator[Trouble]:
    if state.obstacle:
        what = "adopted" if state.wanted else "given back"
        yield Trouble("adoption", f"the robot's graph is not {what}: {state.obstacle}")


def _samples(state: AdoptState) -> dict[str, Samples]:
    return {"rosrv_adopted": [((), float(state.phase == "taken"))]}


def _line(state: AdoptState) -> tuple[str, Any]:
    texts = {
        "taken": f"{counted(state.nodes, 'node')} of {state.master} since {state.since_utc}",
        "taking": "the robot's graph is being taken over",
        "giving": "the robot's graph is being given back",
        "given": "the robot's graph is being given back",
        "free": f"the robot's nodes use {state.master or 'their own master'}",
    }
    away = "" if state.present or state.phase != "taken" else "; its master is away: a release will start one"
    return "adopted", texts[state.phase] + away


ADOPT_VIEW = FeatureView(
    (
        StateView(
            "adopt",
            AdoptState,
            "the adoption of a running robot's graph, or null without one",
            before="handled_alarms",
            kinds={
                "adoption": AlarmKind(
                    "alarm", "correct what keeps the graph from being adopted or given back"
                )
            },
            alarms=_alarms,
            metrics=_METRICS,
            samples=_samples,
            line=_line,
        ),
    ),
)
