"""The state of an appliance that is one of two (docs/standby.md)."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.answers.field_docs import Moment, Name, VirtualAddress, doc


class OtherAppliance(msgspec.Struct, frozen=True):
    """The other appliance, as this one sees it."""

    name: Name
    address: VirtualAddress
    connected: Annotated[bool, doc("whether the replication between both is open")]
    in_sync: Annotated[bool, doc("whether the standby has all acknowledged changes")]
    behind_changes: Annotated[int, doc("changes of the state that it lacks; on a standby always 0")]
    behind_bytes: Annotated[int, doc("bytes of these changes that are kept in memory")]
    waiting_seconds: Annotated[
        float | None, doc("age of the oldest answer that waits for it, or null if none waits")
    ]
    reason: Annotated[str, doc("why the last replication ended, or empty if it is open, or never began")]
    trouble_seconds: Annotated[
        float | None,
        doc(
            "how long it has been away, or (on the active appliance) not in sync or not checked, or null if none"
            " of them"
        ),
    ]
    witness_seconds: Annotated[
        float | None,
        doc(
            "on the active appliance: seconds since the witness last answered the other one, or null if not known"
        ),
    ]
    refusal: Annotated[
        str,
        doc("why the standby refused the last change of the active appliance, or empty once it accepts one"),
    ] = ""


class WitnessSeen(msgspec.Struct, frozen=True):
    """The witness on the robot, as this appliance sees it."""

    address: VirtualAddress
    answered_seconds: Annotated[
        float | None, doc("seconds since its last answer, or null if it never answered")
    ]
    holder: Annotated[str, doc("the appliance that has the lease, or empty if none has it yet")]
    refusal: Annotated[
        str, doc("why it refuses this appliance, such as with an older lease, or empty if it does not")
    ]
    trouble: Annotated[
        str, doc("why it could not carry out a takeover, such as a full disk, or empty if it could")
    ]
    follower_trouble: Annotated[
        str,
        doc(
            "the troubles of followers, such as `arm: it shut out both appliances 5 times in a minute`, or empty"
            " if none reported one within a minute"
        ),
    ]


class StandbyState(msgspec.Struct, frozen=True):
    """The state of two appliances, of which one is active; `since` is when this one took its role."""

    name: Annotated[str, doc("this appliance")]
    address: VirtualAddress
    role: Annotated[
        Literal["active", "standby"],
        doc("active: the robot's nodes use this appliance; standby: it is ready to take over, or catches up"),
    ]
    epoch: Annotated[int, doc("number of the takeover that this appliance knows last")]
    since: Moment
    fixed: Annotated[str, doc("the address at which the robot's nodes reach the active appliance")]
    answers_alone: Annotated[
        bool, doc("active: the other appliance is not in sync, so no answer waits for it")
    ]
    other: OtherAppliance
    witness: WitnessSeen
    obstacle: Annotated[
        str,
        doc(
            "why the standby cannot take over, although it follows, or empty if its last check found no reason"
        ),
    ]
    troubles: Annotated[
        list[str], doc("why the standby could not take over now, with the remedies, or empty if it could")
    ]
    not_serving: Annotated[
        str,
        doc("why the active appliance does not serve the robot, and keeps the lease, or empty if it serves"),
    ] = ""
