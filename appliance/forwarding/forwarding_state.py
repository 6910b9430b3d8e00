"""The state of a forwarder of the audit log, with its samples in `/metrics`."""

from typing import Annotated

import msgspec

from appliance.channel.answers.field_docs import doc
from appliance.features.view import Samples


class ForwardingState(msgspec.Struct, frozen=True):
    """How far the audit log is forwarded: `behind` records wait, the oldest for `seconds`; `missed` were removed.

    `sent` messages since the forwarder started, up to the record `sequence` and the checkpoint `checkpoint`.
    """

    sent: Annotated[int, doc("messages sent since the forwarder started")]
    sequence: Annotated[int, doc("sequence number in the audit log")]
    checkpoint: Annotated[int, doc("number of the last checkpoint that was sent")]
    behind: Annotated[int, doc("number of records that wait")]
    seconds: Annotated[float, doc("how long the oldest record has waited")]
    missed: Annotated[int, doc("records that retention removed before they were sent")]
    trouble: Annotated[str, doc("why forwarding is stopped, or empty if it is not")]
    to: Annotated[str, doc("the receiver")]
    send: Annotated[str, doc("which records are sent: all, or denials")]


def samples_of(to: str, state: ForwardingState) -> dict[str, Samples]:
    return {
        f"rosrv_{to}_up": [((), not state.trouble)],
        f"rosrv_{to}_sent_total": [((), state.sent)],
        f"rosrv_{to}_lag_records": [((), state.behind)],
        f"rosrv_{to}_lag_seconds": [((), state.seconds)],
        f"rosrv_{to}_missed_total": [((), state.missed)],
    }
