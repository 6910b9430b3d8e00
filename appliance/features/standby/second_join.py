"""`rosrv standby join FILE` on the other appliance, whose state becomes a copy of the first one's."""

import os
from pathlib import Path

from appliance.backup.contents import BackupError
from appliance.backup.create import back_up
from appliance.base import clock
from appliance.cli.output import say_json, usage_error
from appliance.features.standby.first_join import existing_membership
from appliance.features.standby.membership import (
    LEFT_FILE,
    Membership,
    MembershipError,
    load_membership,
    path_of,
    save_membership,
)
from appliance.features.standby.process import EPOCH
from appliance.features.standby.sealed_authority import SealedAuthority, keep_sealed
from appliance.supervisor.state_directory import StateDirectory
from appliance.supervisor.users import account_of
from rosmop.tool.terminal import refused, say

_VERB = "rosrv standby"


def join_second(file: Path, state: Path, *, again: bool, as_json: bool) -> None:
    """Make this appliance the second of a pair. It must be stopped, or later changes would be lost."""
    membership = _given(file)
    directory = StateDirectory(state)
    try:
        backup = _join(membership, state, again=again)
    except OSError as error:
        raise refused([f"{_VERB}: {error.filename or state}: {error.strerror}; run this as root"]) from None
    finally:
        directory.close()
    if as_json:
        shown = None if backup is None else str(backup)
        say_json({"name": membership.name, "other": membership.other, "backup": shown})
        return
    say(f"This appliance is {membership.name} ({membership.address}) at its next start: start it.")
    say(f"Its registrations, parameters, policy and tokens become those of {membership.other}.")
    if backup is not None:
        say(f"Its own are in {backup}; to use them again: rosrv restore {backup} --state NEW-FOLDER")
    if membership.sealed_key:
        say(f"It can sign certificates once it has the same ipsec.ca_passphrase_file as {membership.other}.")
    say(f"Remove {file}: it has private keys.")


def _given(file: Path) -> Membership:
    try:
        membership = load_membership(file)
    except MembershipError as error:
        reason = f"{file} is not a file standby-NAME.json of the first appliance: {error.__cause__}"
        raise usage_error(reason, _VERB) from None
    except OSError as error:
        raise usage_error(f"{file}: {error.strerror}", _VERB) from None
    if membership is None:
        raise usage_error(
            f"{file} does not exist; the first appliance writes it: rosrv standby join --output", _VERB
        )
    if not (
        membership.witness_key and membership.peer_key and membership.key and membership.other_certificate
    ):
        raise usage_error(f"{file} has no keys; copy it from the first appliance again", _VERB)
    return membership


def _join(membership: Membership, state: Path, *, again: bool) -> Path | None:
    path = path_of(state)
    earlier = existing_membership(path)
    if earlier == membership.unsealed():
        return None
    if earlier is not None and not again:
        raise refused(
            [
                f"{_VERB}: this appliance is already {earlier.name} of the pair {earlier.name} and {earlier.other};"
                " leave that pair first (rosrv standby leave), or give --force"
            ]
        )
    backup = None
    if (state / "control" / "state.db").exists():
        path.parent.mkdir(mode=0o700, exist_ok=True)
        backup = path.with_name(f"before-{clock.utc_now():%Y%m%dT%H%M%SZ}.tar.gz")
        try:
            back_up(state, backup)
        except BackupError as error:
            raise refused([f"{_VERB}: {error}; nothing was changed"]) from None
    # An epoch belongs to a pair. This one is kept if the appliance was in this pair: it may have promised something.
    last = earlier or existing_membership(path.with_name(LEFT_FILE))
    if last is None or last.certificate != membership.certificate:
        (state / "lease" / EPOCH).unlink(missing_ok=True)
    if membership.sealed_key:
        account = account_of("rosrv-signer")
        sealed = SealedAuthority(membership.sealed_certificate, membership.sealed_key)
        keep_sealed(state / "signer", sealed, (account.uid, account.gid) if os.geteuid() == 0 else None)
    save_membership(path, membership.unsealed())
    return backup
