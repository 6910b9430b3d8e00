"""An explanation as data for a record, for the CLI and for REST: bounded, in the words of the specification."""

import datetime
from collections.abc import Callable, Mapping
from typing import Any

from appliance.rosmop.deciding import deciding
from appliance.rosmop.outcomes import Outcome, Verdict
from appliance.rosmop.why import SEQ, Happened

_EACH_END = 5
"""So many of the first and of the last events are told; how many there are between them is said."""


def explained(verdict: Verdict, who: Callable[[int], Mapping[str, str]]) -> dict[str, Any]:
    """`why` of a verdict; nothing where it was not asked or is not known. `who` names the source of a message."""
    why = verdict.why
    if why is None:
        return {}
    events = [_event(verdict, one, who) for one in why.events]
    between = len(events) - 2 * _EACH_END
    said: dict[str, Any] = {"events": events}
    if between > 0:
        said = {"events": [*events[:_EACH_END], *events[-_EACH_END:]], "left_out": between}
    said["fewest"] = why.fewest
    if why.since is not None:
        said["since"] = moment(why.since)
    decided = deciding(verdict.source, why)
    if decided:
        said["decided"] = decided
    return {"why": said}


def conditions(outcome: Outcome) -> dict[str, Any]:
    """`conditions` that were met, with the values that they compared."""
    return {"conditions": outcome.conditions} if outcome.looked else {}


def moment(time_ns: int) -> str:
    """A time in UTC, with microseconds."""
    return datetime.datetime.fromtimestamp(time_ns / 1e9, datetime.UTC).isoformat(timespec="microseconds")


def _event(verdict: Verdict, one: Happened, who: Callable[[int], Mapping[str, str]]) -> dict[str, Any]:
    event: dict[str, Any] = {"event": verdict.source.events[one.event], "time": moment(one.time)}
    event |= {"state": one.state} if one.state else {}
    event |= who(one.sender.source) if one.sender.source else {}
    return event | ({"seq": one.sender.number} if one.sender.kind == SEQ else {})
