"""`rosrv standby join|leave`: make an appliance one of two, or a single one. Both work without a running appliance."""

from pathlib import Path

import msgspec

from appliance.cli.connection.target import DEFAULT_STATE, State
from appliance.cli.output import Json, say_json, usage_error
from appliance.standby.membership import (
    LEFT_FILE,
    Membership,
    MembershipError,
    load_membership,
    path_of,
    save_membership,
)
from rosmop.tool.terminal import say

_VERB = "rosrv standby"


def leave(state: State = DEFAULT_STATE, as_json: Json = False) -> None:
    """Make this appliance a single one at its next start. The other appliance and the robot are not changed.

    Example: rosrv standby leave --state /var/lib/rosrv
    """
    path = path_of(state)
    membership = _membership(path)
    if membership is None:
        raise usage_error(f"{state} is not the state of one of two appliances", _VERB)
    try:
        # Without secrets: `join` compares it with the file that it is given.
        left = msgspec.structs.replace(membership, witness_key="", peer_key="", key="")
        save_membership(path.with_name(LEFT_FILE), left)
        path.unlink()
    except OSError as error:
        raise usage_error(f"{path} cannot be removed: {error.strerror}", _VERB) from None
    if as_json:
        say_json({"name": membership.name, "other": membership.other})
        return
    say(f"{membership.name} is a single appliance at its next start: restart it.")
    say(f"On the robot ({membership.witness}): sudo /etc/rosrv/remove.sh   and on each follower likewise")
    say(
        f"There, set ROS_MASTER_URI to the address of this appliance, {membership.address}, and start the nodes again."
    )
    say(f"On {membership.other} ({membership.other_address}): rosrv standby leave, or rosrv purge")


def _membership(path: Path) -> Membership | None:
    """Return the membership in a file; exit with status 2 if it cannot be read."""
    try:
        return load_membership(path)
    except MembershipError as error:
        raise usage_error(str(error), _VERB) from None
    except OSError as error:
        raise usage_error(f"{path} cannot be read: {error.strerror}; run this as root", _VERB) from None
