"""The commands `rosrv standby join|leave|repair`, which work without a running appliance."""

import os
from pathlib import Path
from typing import Annotated

import typer
from msgspec.structs import replace

from appliance.backup.contents import BackupError
from appliance.backup.create import back_up
from appliance.base import clock
from appliance.base.owner_access import acting_as_owner
from appliance.cli.connection.target import DEFAULT_STATE, State
from appliance.cli.output import Json, say_json, usage_error
from appliance.features.standby.first_join import (
    JoinOptions,
    SealedAuthority,
    existing_membership,
    join_first,
    keep_sealed,
)
from appliance.features.standby.membership import (
    LEFT_FILE,
    PORT,
    Membership,
    MembershipError,
    load_membership,
    path_of,
    save_membership,
)
from appliance.features.standby.process import EPOCH
from appliance.supervisor.state_directory import STORED, StateDirectory
from appliance.supervisor.users import account_of
from rosmop.tool.terminal import printable, refusal, say

# `rosrv standby join FILE` on the other appliance, whose state becomes a copy of the first one's.


def join_second(file: Path, state: Path, *, again: bool, as_json: bool) -> None:
    """Make this appliance the second of a pair. It must be stopped, or later changes would be lost."""
    membership = _read(file)
    directory = StateDirectory(state)
    try:
        backup = _join(membership, state, again=again)
    except OSError as error:
        raise refusal([f"{_VERB}: {error.filename or state}: {error.strerror}; run this as root"]) from None
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


def _read(file: Path) -> Membership:
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
    if earlier == membership.without_secrets():
        return None
    if earlier is not None and not again:
        raise refusal(
            [
                f"{_VERB}: this appliance is already {earlier.name} of the pair {earlier.name} and {earlier.other};"
                " leave that pair first (rosrv standby leave), or give --force"
            ]
        )
    backup = None
    with acting_as_owner(state / "control"):
        stored = (state / STORED).exists()
    if stored:
        path.parent.mkdir(mode=0o700, exist_ok=True)
        backup = path.with_name(f"before-{clock.utc_now():%Y%m%dT%H%M%SZ}.tar.gz")
        try:
            back_up(state, backup)
        except BackupError as error:
            raise refusal([f"{_VERB}: {error}; nothing was changed"]) from None
    # An epoch belongs to a pair. This one is kept if the appliance was in this pair: it may have promised something.
    last = earlier or existing_membership(path.with_name(LEFT_FILE))
    if last is None or last.certificate != membership.certificate:
        with acting_as_owner(state / "lease"):
            (state / "lease" / EPOCH).unlink(missing_ok=True)
    if membership.sealed_key:
        account = account_of("rosrv-signer")
        sealed = SealedAuthority(membership.sealed_certificate, membership.sealed_key)
        keep_sealed(state / "signer", sealed, (account.uid, account.gid) if os.geteuid() == 0 else None)
    save_membership(path, membership.without_secrets())
    return backup


_VERB = "rosrv standby"
_File = Annotated[
    Path | None,
    typer.Argument(help="On the other appliance: the file standby-NAME.json that the first one wrote"),
]
_Address = Annotated[str | None, typer.Option(help="Address of this appliance, as the robot sees it (IPv4)")]
_Other = Annotated[str | None, typer.Option(help="Address of the other appliance")]
_Witness = Annotated[str | None, typer.Option(help="Address of the robot's computer")]
_Fixed = Annotated[
    str | None,
    typer.Option(help="Unused address in the robot's network, at which nodes reach the active appliance"),
]
_Name = Annotated[
    str | None, typer.Option(help="Name of this appliance (default: its name in an earlier pair, or `a`)")
]
_OtherName = Annotated[
    str | None, typer.Option(help="Name of the other appliance (default: as in an earlier pair, or `b`)")
]
_Followers = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME=ADDRESS", help="Another computer that uses the fixed address (repeatable)"),
]
_Ports = Annotated[
    str | None,
    typer.Option(
        help="TCP ports at the fixed address: 11311,19001-26000 (default: those of the appliance's configuration"
        " and policy)"
    ),
]
_PeerPort = Annotated[int, typer.Option(help="Port between the appliances, UDP and TCP", min=1, max=65_535)]
_Configuration = Annotated[
    Path | None,
    typer.Option(
        help="Configuration file, for the default of --ports (default: ROSRV_CONFIG, else ./appliance.yaml)"
    ),
]
_KitFolder = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        metavar="DIR",
        help="New folder for the files of the other machines; it contains private keys",
    ),
]
_Force = Annotated[
    bool,
    typer.Option(
        "--force", help="Join even if this appliance is one of a pair; then set up all machines again"
    ),
]


def join(
    file: _File = None,
    *,
    state: State = DEFAULT_STATE,
    address: _Address = None,
    other: _Other = None,
    witness: _Witness = None,
    fixed: _Fixed = None,
    name: _Name = None,
    other_name: _OtherName = None,
    follower: _Followers = None,
    ports: _Ports = None,
    port: _PeerPort = PORT,
    config: _Configuration = None,
    out: _KitFolder = None,
    force: _Force = False,
    as_json: Json = False,
) -> None:
    """Make this appliance one of two at its next start, and write the files for the other machines.

    Run it first on the appliance that has all data. Then give the file that it wrote to the other appliance.

    Example: rosrv standby join --address 192.168.1.2 --other 192.168.1.3 --witness 192.168.1.10 --fixed 192.168.1.100
    --output standby-kit

    Example: rosrv standby join standby-b.json
    """
    if file is not None:
        if any((address, other, witness, fixed, follower, ports, config, out)):
            raise usage_error(f"{file} has all settings: give --state and --force only", _VERB)
        join_second(file, state, again=force, as_json=as_json)
        return
    if address is None or other is None or witness is None or fixed is None or out is None:
        raise _missing(address=address, other=other, witness=witness, fixed=fixed, output=out)
    options = JoinOptions(
        state=state, address=address, other=other, witness=witness, fixed=fixed, name=name, other_name=other_name,
        followers=tuple(follower or ()), ports=ports, port=port, config=config, out=out, again=force,
    )  # fmt: skip
    join_first(options, as_json=as_json)


def _missing(**options: object) -> typer.Exit:
    missing = ", ".join(f"--{option}" for option, value in options.items() if value is None)
    return usage_error(
        f"missing {missing}; on the other appliance, give the file standby-NAME.json instead", _VERB
    )


def leave(state: State = DEFAULT_STATE, as_json: Json = False) -> None:
    """Make this appliance a single one at its next start. The other appliance and the robot are not changed.

    Example: rosrv standby leave --state /var/lib/rosrv
    """
    path = path_of(state)
    membership = None
    try:
        membership = load_membership(path)
        if membership is None:
            raise _single(state)
        # Without secrets: `join` compares it with the file that it gets.
        left = replace(membership, witness_key="", peer_key="", key="")
        save_membership(path.with_name(LEFT_FILE), left)
    except MembershipError as error:
        typer.echo(f"{_VERB}: {error}; it is removed", err=True)
    except OSError as error:
        raise usage_error(f"{path}: {error.strerror}; run this as root", _VERB) from None
    try:
        path.unlink()
    except OSError as error:
        raise usage_error(f"{path} cannot be removed: {error.strerror}", _VERB) from None
    if as_json:
        say_json(
            {
                "name": membership.name if membership else "",
                "other": membership.other if membership else "",
            }
        )
        return
    if membership is None:
        say("This appliance is a single one at its next start: restart it.")
        return
    say(f"{membership.name} is a single appliance at its next start: restart it.")
    say(f"On the robot ({membership.witness}) and on each follower: sudo /etc/rosrv/remove-witness.sh")
    say(f"Start the nodes again with the address of this appliance, {membership.address}, in ROS_MASTER_URI.")
    say(
        f"On {membership.other} ({membership.other_address}): stop it, then rosrv standby leave, or rosrv purge"
    )


def _single(state: Path) -> typer.Exit:
    return usage_error(
        f"{state} is not the state of one of two appliances; name another with --state, or run rosrv standby join",
        _VERB,
    )


def repair(state: State = DEFAULT_STATE, as_json: Json = False) -> None:
    """Forget the stored epoch, so that the next start takes the witness's epoch. Stop the appliance first.

    The epoch is a number that grows with each takeover. Use this command if the witness reports a smaller epoch
    although its disk was not restored. Run it on both appliances. Exit status: 0 done, 1 the appliance runs, 2 it is
    not one of a pair.

    Example: rosrv standby repair
    """
    if not path_of(state).exists():
        raise _single(state)
    directory = StateDirectory(state)
    file = state / "lease" / EPOCH
    try:
        with acting_as_owner(file.parent):
            epoch = file.read_text("ascii", "replace").strip()[:32] if file.exists() else ""
            file.unlink(missing_ok=True)
    except OSError as error:
        raise usage_error(f"{file} cannot be removed: {error.strerror}; run this as root", _VERB) from None
    finally:
        directory.close()
    if as_json:
        say_json({"forgotten": epoch})
    else:
        say(
            f"Epoch {printable(epoch) or 'none'} is forgotten: start the appliance, then rosrv standby status."
        )
