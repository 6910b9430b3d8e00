"""List the views of the features. To remove a feature, also remove its import and its row here."""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import msgspec

from appliance.base.user_errors import UserError
from appliance.channel.answers.field_docs import doc
from appliance.features.adopt.view import ADOPT_VIEW
from appliance.features.approvals.view import APPROVALS_VIEW
from appliance.features.authority.view import AUTHORITY_VIEW
from appliance.features.doors.view import DOORS_VIEW
from appliance.features.fleet.view import FLEET_VIEW
from appliance.features.guards.view import GUARDS_VIEW
from appliance.features.recorder.view import RECORDER_VIEW
from appliance.features.standby.view import STANDBY_VIEW
from appliance.features.syslog.view import SYSLOG_VIEW
from appliance.features.view import FeatureView, PairView, StateView

VIEWS: tuple[FeatureView, ...] = (
    SYSLOG_VIEW, STANDBY_VIEW, FLEET_VIEW, RECORDER_VIEW, DOORS_VIEW, APPROVALS_VIEW, GUARDS_VIEW,
    ADOPT_VIEW, AUTHORITY_VIEW,
)  # fmt: skip
STATES: tuple[StateView[Any], ...] = tuple(state for view in VIEWS for state in view.states)


def with_states(kind: type[msgspec.Struct], part: str) -> Any:
    fields: list[Any] = []
    for field in msgspec.structs.fields(kind):
        defaults = {"default": field.default, "default_factory": field.default_factory}
        fields.append((field.name, field.type, msgspec.field(**defaults)))
    for state in STATES:
        if state.part == part:
            names = [name for name, *_ in fields]
            given = {} if state.required else {"default": None}
            added = (state.field, Annotated[state.kind | None, doc(state.doc)], msgspec.field(**given))
            fields.insert(names.index(state.before) if state.before else len(names), added)
    return msgspec.defstruct(
        kind.__name__, fields, namespace={"__doc__": kind.__doc__}, module=kind.__module__, frozen=True
    )


def states_in(states: Mapping[str, Any], part: str) -> dict[str, Any]:
    return {view.field: states.get(view.field) for view in STATES if view.part == part}


def states_of(status: Any) -> Iterator[tuple[StateView[Any], Any]]:
    for view in STATES:
        state = getattr(status.audit if view.part == "audit" else status, view.field)
        if state is not None:
            yield view, state


def pair_view() -> PairView:
    for view in VIEWS:
        if view.pair is not None:
            return view.pair
    raise UserError("this appliance is one of two, which this rosrv cannot show: use one with `standby`")
