"""The link control <-> lease, of an appliance that is one of two (docs/standby.md).

Control may answer without the standby only after a `LeaseState` with `alone` and a new `permission`. To end
this, control first waits for the standby again, and then reports `caught_up` with that permission, after
which the lease asks the witness to add the standby. So a standby in the in-sync set has every answered
change.
"""

from typing import Annotated

import msgspec

from appliance.channel.messages.message import Message

_Epoch = Annotated[int, msgspec.Meta(ge=0, lt=1 << 62)]


class LeaseState(Message):
    """The lease reports its state after each change, and at least once a second.

    `until` is the time (seconds of CLOCK_BOOTTIME) to which this appliance may answer; 0: it is passive.
    `epoch` is the highest known one. `alone`: the witness has removed the other appliance from the in-sync
    set. `permission` counts these messages with `alone`. `answered` and `heard` are the times of the last
    answer of the witness and the last message of the other appliance, None if there was none.
    `other_witnessed` is the time of the last answer of the witness to the other appliance, None if that is
    unknown. `handover_obstacle` is why the other appliance could not claim if this one gave the lease up now;
    `trouble` is why the witness could not save a takeover.
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
    """The lease answers `HandOverWanted`: an empty reason if this appliance is passive now."""

    reason: str


class ReplicationReported(Message):
    """Control reports the replication after each change, and every 0.2 s while a change waits.

    `permission` is the last one that control used. `caught_up`: control waits for the standby again, which has all
    changes. `waiting_since` is the time (CLOCK_BOOTTIME) of the oldest answer that waits for the standby; it is 0
    after a takeover, until the standby connects or is removed.
    """

    permission: int
    caught_up: bool
    waiting_since: float | None


class EpochSeen(Message):
    """Control accepts data of an active appliance with this epoch."""

    epoch: _Epoch


class ControlPresent(Message):
    """Control stands by or serves, so this appliance may be active. A new link begins without this."""


class ControlUnready(Message):
    """Control stands by, but could not serve: this appliance does not claim until the next `ControlPresent`."""


class ControlServes(Message):
    """Control of an active appliance reports repeatedly that it serves the robot, or the obstacle to it.

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
