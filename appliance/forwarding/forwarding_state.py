"""The state of a forwarder of the audit log, with its samples in `/metrics`."""

from typing import Annotated

import msgspec

from appliance.channel.answers.field_docs import doc
from appliance.features.view import Samples


class ForwardingState(msgspec.Struct, frozen=True):
    """How far the audit log is forwarded: `behind` records wait, the oldest for `seconds`; `missed` were removed.

    `sent` messages since the forwarder started, up to the record `sequence` and the checkpoint `checkpoint`.
    """

    sent: int
    sequence: int
    checkpoint: int
    behind: int
    seconds: float
    missed: int
    trouble: Annotated[str, doc("why forwarding is stopped, or empty if it is not")]
    to: str
    send: str


def samples_of(to: str, state: ForwardingState) -> dict[str, Samples]:
    return {
        f"rosrv_{to}_up": [((), not state.trouble)],
        f"rosrv_{to}_sent_total": [((), state.sent)],
        f"rosrv_{to}_lag_records": [((), state.behind)],
        f"rosrv_{to}_lag_seconds": [((), state.seconds)],
        f"rosrv_{to}_missed_total": [((), state.missed)],
    }
