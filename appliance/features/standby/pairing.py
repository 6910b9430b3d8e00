"""Read the membership of one of two appliances, and find what its start needs."""

from pathlib import Path

from appliance.features.standby.lease_watch import LeaseWatch
from appliance.features.standby.membership import (
    LEASE_FILE,
    LEASE_NICE,
    LINK_FILE,
    MembershipError,
    encoded,
    load_membership,
    path_of,
)
from appliance.supervisor.errors import StartError
from appliance.supervisor.service_gate import Pairing

_FIXED_AUTHORITY = (
    "this appliance is one of two, which share the authority: end the pair first (rosrv standby leave on both), rotate,"
    " and join again"
)


def pairing_in(state: Path) -> Pairing | None:
    try:
        membership = load_membership(path_of(state))
    except MembershipError as error:
        raise StartError(str(error)) from error
    except OSError as error:
        raise StartError(
            f"{state} cannot be used as the state directory: {error.strerror}; name another with --state"
        ) from error
    if membership is None:
        return None
    name, other = membership.name, membership.other
    return Pairing(
        robot=membership.witness,
        other=membership.other_address,
        port=membership.port,
        files=(
            (LEASE_FILE, "rosrv-lease", encoded(membership.for_lease())),
            (LINK_FILE, "rosrv", encoded(membership.for_control())),
        ),
        nice=LEASE_NICE,
        gate=LeaseWatch,
        fixed_authority=_FIXED_AUTHORITY,
        waiting_event={"event": "standby", "name": name, "other": other},
        waiting_text=f"This appliance ({name}) is ready to be active, or to take over from {other}"
        f" ({membership.other_address}): rosrv standby status",
        ready="ready to take over: rosrv standby status",
    )
