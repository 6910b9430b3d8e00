"""The link control <-> lease, of an appliance that is one of two (docs/standby.md).

A standby in the in-sync set has every answered change. So control answers without it only after a `LeaseState`
with `alone` and a new `permission`, and waits for it again before it reports `caught_up`, after which the witness
may add it.
"""

from typing import Annotated

import msgspec

from appliance.channel.messages.message import Message

_Epoch = Annotated[int, msgspec.Meta(ge=0, lt=1 << 62)]


class LeaseState(Message):
    """The lease, after each change and at least once a second; times are seconds of CLOCK_BOOTTIME.

    This appliance may answer until `until`; 0: it is passive. `alone`: the witness has removed the other
    appliance from the in-sync set. `permission` counts these messages with `alone`. `answered` is the time of the
    witness's last answer, `heard` of the other appliance's last message. `handover_obstacle` is why that one
    could not claim now, `trouble` why the witness could not save a takeover.
    """

    until: float
    epoch: _Epoch
    alone: bool
    permission: int
    in_sync: bool
    holder: str
    refusal: str
    answered: float | None
    heard: float | None
    other_witnessed: float | None
    handover_obstacle: str
    trouble: str


class HandOverAnswered(Message):
    """The answer to `HandOverWanted`: an empty reason if this appliance is passive now."""

    reason: str


class ReplicationReported(Message):
    """The replication, after each change, and every 0.2 s while a change waits.

    `waiting_since` is the time (CLOCK_BOOTTIME) of the oldest answer that waits for the standby; it is 0 after a
    takeover, until the standby connects or is removed.
    """

    permission: int
    caught_up: bool
    waiting_since: float | None


class EpochSeen(Message):
    """Control accepts data of an active appliance with this epoch."""

    epoch: _Epoch


class ControlPresent(Message):
    """Control stands by or serves, so this appliance may be active. A link begins without this."""


class ControlUnready(Message):
    """Control stands by, but could not serve: this appliance does not claim until the next `ControlPresent`."""


class ControlServes(Message):
    """Control serves, or an obstacle prevents it; this is reported repeatedly.

    `keeps_state`: a monitor holds its topics if its state is lost, as it is at an unplanned takeover.

    """

    obstacle: str
    keeps_state: bool


class HandOverWanted(Message):
    """Control has stored everything on the standby, and wants it to take over."""


LeaseLink = (
    LeaseState
    | HandOverAnswered
    | ReplicationReported
    | EpochSeen
    | ControlPresent
    | ControlUnready
    | ControlServes
    | HandOverWanted
)
