"""Show in the status which guards limit or stop the robot now."""

import datetime
from collections.abc import Iterator
from typing import Annotated

import msgspec

from appliance.channel.answers.field_docs import Moment, doc
from appliance.features.view import FeatureView, StateView, Trouble


class ActingGuard(msgspec.Struct, frozen=True):
    """A guard that limits or stops the robot now."""

    name: Annotated[str, doc("the guard")]
    since: Annotated[Moment, doc("it has done so since then, without a pause of 2 seconds")]


class GuardsState(msgspec.Struct, frozen=True):
    """The loaded guards."""

    loaded: Annotated[int, doc("all guards, also disabled ones and those in shadow mode")]
    acting: Annotated[list[ActingGuard], doc("the guards that limit or stop the robot now")]


def _since(guard: ActingGuard) -> str:
    began = datetime.datetime.fromtimestamp(guard.since, datetime.UTC)
    return f"{guard.name} has limited or stopped the robot since {began:%Y-%m-%d %H:%M:%SZ}"


def _alarms(state: GuardsState) -> Iterator[Trouble]:
    for guard in state.acting:
        text = f"the guard {_since(guard)}: rosrv audit search --category monitor --text {guard.name}"
        yield Trouble("notice", f"guard-acts:{guard.name}", text)


def _line(state: GuardsState) -> tuple[str, str]:
    return "guards", "; ".join([f"{state.loaded} loaded", *map(_since, state.acting)])


GUARDS_VIEW = FeatureView(
    "guards",
    (StateView("guards", GuardsState, "the guards, or null if none is loaded", alarms=_alarms, line=_line),),
)
