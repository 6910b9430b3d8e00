"""The messages between control and the process `lease` of one of two appliances (docs/standby.md).

For invariant 6 of `lease.py`, control answers without the standby only after a `LeaseState` with `alone` and a new
`permission`, and waits for it again before it reports `caught_up`.
"""

from typing import Annotated

import msgspec

from appliance.channel.messages.message import Message

_Epoch = Annotated[int, msgspec.Meta(ge=0, lt=1 << 62)]


class LeaseState(Message):
    """The lease, after each change and at least once a second; times are seconds of CLOCK_BOOTTIME."""

    until: float
    """The end of this appliance's right to answer, or 0 if it is passive."""
    epoch: _Epoch
    alone: bool
    """Whether the witness has removed the other appliance from the in-sync set."""
    permission: int
    """Counts the times at which `alone` was granted."""
    in_sync: bool
    """Whether the appliance that is not active has all acknowledged changes, as the witness last reported."""
    holder: str
    refusal: str
    answered: float | None
    """The time of the witness's last answer."""
    heard: float | None
    """The time of the other appliance's last message."""
    other_witnessed: float | None
    takeover_obstacle: str
    """Why the appliance that is not active could not claim now."""
    trouble: str
    """Why the witness could not carry out a takeover."""
    follower_trouble: str = ""
    """The troubles that followers report to the witness."""
    sole: bool = False
    """Whether the witness's in-sync set names only this appliance."""
    expired_since: float | None = None
    """The time since which the witness has said that no appliance holds the lease."""
    fault: str = ""
    """Why the active appliance does not serve, and keeps the lease."""


class HandOverAnswered(Message):
    """The answer to `HandOverWanted`: an empty reason if this appliance is passive now."""

    reason: str


class ReplicationReported(Message):
    """The replication, after each change, and every 0.2 s while a change waits."""

    permission: int
    caught_up: bool
    waiting_since: float | None
    """The time (CLOCK_BOOTTIME) of the oldest answer that waits for the standby; after a takeover 0, until the
    standby connects or is removed.
    """


class EpochSeen(Message):
    """Control accepts data of an active appliance with this epoch."""

    epoch: _Epoch


class ControlPresent(Message):
    """Control stands by or serves, so this appliance may be active. A link begins without this."""

    able: bool = True
    """Whether the other appliance may give the lease to this one, and not only lose it."""


class ControlUnready(Message):
    """Control stands by, but could not serve: this appliance does not claim until the next `ControlPresent`."""


class ControlServes(Message):
    """Control serves, or an obstacle prevents it; this is reported repeatedly."""

    obstacle: str
    keeps_state: bool
    """Whether a monitor holds its topics if its state is lost, as at an unplanned takeover."""


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
