"""The requests about alarms."""

from typing import Annotated

import msgspec

from appliance.channel.admin import AdminRequest
from appliance.channel.alarms import AlarmList
from appliance.channel.answers.field_docs import doc
from appliance.channel.rest_operation import rest

LONGEST_SILENCE_SECONDS = 7 * 86_400.0


class OneAlarm(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An alarm to acknowledge."""

    kind: Annotated[str, doc("the alarm's name", min_length=1, max_length=300)]
    note: Annotated[str, doc("shown to operators", max_length=200)] = ""


class SilencedAlarm(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An alarm to silence."""

    kind: Annotated[str, doc("the alarm's name", min_length=1, max_length=300)]
    seconds: Annotated[
        Annotated[float, msgspec.Meta(ge=1, le=LONGEST_SILENCE_SECONDS)] | None,
        doc("the silence ends after this time; with null, it ends now"),
    ] = None
    note: Annotated[str, doc("reason, shown to operators", max_length=200)] = ""


@rest("viewer", "GET", "/v1/alarms", name="alarms", tag="status")
class AlarmsWanted(AdminRequest[AlarmList], frozen=True, tag="alarms"):
    """The present alarms, and the denials and drops of the last minute."""


@rest(
    "operator", "POST", "/v1/alarms/acknowledge", name="acknowledge_alarm", tag="status", body=OneAlarm,
    problems={404: "There is no such alarm now."},
)  # fmt: skip
class AlarmAcknowledge(AdminRequest[AlarmList], frozen=True, tag="alarm acknowledge"):
    """Record who takes care of an alarm. It remains an alarm, with that name, until its condition ends."""

    kind: str
    note: str = ""


@rest(
    "operator", "POST", "/v1/alarms/silence", name="silence_alarm", tag="status", body=SilencedAlarm,
    problems={404: "There is no such alarm now."},
)  # fmt: skip
class AlarmSilence(AdminRequest[AlarmList], frozen=True, tag="alarm silence"):
    """Make an alarm a notice for a time: `rosrv status` then exits with 0. Without `seconds`, end its silence."""

    kind: str
    seconds: float | None = None
    note: str = ""


REQUESTS = (AlarmsWanted, AlarmAcknowledge, AlarmSilence)
