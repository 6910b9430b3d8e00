"""The requests about alarms."""

from typing import Annotated

import msgspec

from appliance.channel.admin import AdminRequest
from appliance.channel.alarms import AlarmList
from appliance.channel.answers.field_docs import doc
from appliance.channel.rest_bodies import Note
from appliance.channel.rest_operation import Body, rest

LONGEST_SILENCE_SECONDS = 7 * 86_400.0
Kind = Annotated[str, doc("the alarm's name", min_length=1, max_length=300)]


@rest("viewer", "GET", "/v1/alarms", name="alarms", tag="status")
class AlarmsWanted(AdminRequest[AlarmList], frozen=True, tag="alarms"):
    """The present alarms, and the denials and drops of the last minute."""


@rest(
    "operator", "POST", "/v1/alarms/acknowledge", name="acknowledge_alarm", tag="status",
    body=Body("OneAlarm", "An alarm to acknowledge."),
    problems={404: "There is no such alarm now."},
)  # fmt: skip
class AlarmAcknowledge(AdminRequest[AlarmList], frozen=True, tag="alarm acknowledge"):
    """Record who takes care of an alarm. It remains an alarm, with that name, until its condition ends."""

    kind: Kind
    note: Annotated[Note, doc("shown to operators")] = ""


@rest(
    "operator", "POST", "/v1/alarms/silence", name="silence_alarm", tag="status",
    body=Body("SilencedAlarm", "An alarm to silence."),
    problems={404: "There is no such alarm now."},
)  # fmt: skip
class AlarmSilence(AdminRequest[AlarmList], frozen=True, tag="alarm silence"):
    """Make an alarm a notice for a time: `rosrv status` then exits with 0. Without `seconds`, end its silence."""

    kind: Kind
    seconds: Annotated[
        Annotated[float, msgspec.Meta(ge=1, le=LONGEST_SILENCE_SECONDS)] | None,
        doc("the silence ends after this time; with null, it ends now"),
    ] = None
    note: Annotated[Note, doc("reason, shown to operators")] = ""


REQUESTS = (AlarmsWanted, AlarmAcknowledge, AlarmSilence)
