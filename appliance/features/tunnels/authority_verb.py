"""The command `rosrv host authority rotate`."""

import os
from contextlib import closing
from pathlib import Path

import typer

from appliance.backup.contents import BackupError
from appliance.base.erasure import write_over
from appliance.base.owner_access import acting_as
from appliance.cli.connection.target import DEFAULT_STATE, State
from appliance.cli.output import Json, say_json
from appliance.cli.typed_confirmation import Yes, confirm_state
from appliance.features.table import pairing_in
from appliance.ipsec.certificate_authority import CERTIFICATE_FILE, KEY_FILE
from appliance.supervisor.errors import StartError
from appliance.supervisor.state_directory import StateDirectory, foreign
from rosmop.tool.terminal import refusal, say

# Remove the key of the hosts' authority of a stopped appliance; its next start makes another one.
#
# This is for a stolen key, with which anyone can make certificates of trusted hosts. The key file is overwritten
# first.


def rotate_authority(state: Path) -> None:
    state = state.absolute()
    folder = state / "signer"
    try:
        reason = foreign(state)
        if not state.is_dir() or reason is not None:
            raise BackupError(reason or f"the state directory {state} does not exist: give it with --state")
        with closing(StateDirectory(state)):
            _require_single(state)
            with acting_as(folder.stat().st_uid):  # in a container, root may not use the signer's folder
                place = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
                try:
                    write_over(KEY_FILE, place)
                    for name in (KEY_FILE, CERTIFICATE_FILE):
                        os.unlink(name, dir_fd=place)
                    os.fsync(place)
                finally:
                    os.close(place)
    except StartError as error:
        raise BackupError(f"{error}; stop the appliance first") from None
    except FileNotFoundError:
        raise BackupError(f"{folder} has no authority yet: no host was enrolled") from None
    except OSError as error:
        raise BackupError(f"{folder}: {error.strerror}") from error


def _require_single(state: Path) -> None:
    try:
        pairing = pairing_in(state)
    except StartError as error:
        raise BackupError(str(error)) from error
    if pairing is not None:
        raise BackupError(pairing.fixed_authority)


def rotate(
    context: typer.Context,
    state: State = DEFAULT_STATE,
    *,
    yes: Yes = False,  # noqa: ARG001  `confirm_state` reads it
    as_json: Json = False,
) -> None:
    """Erase the key of the hosts' authority; the next start makes a new one. Stop the appliance first.

    Certificates of the earlier authority are then rejected: each tunnel stays closed until its host has
    a new kit.

    Example: rosrv host authority rotate --state /var/lib/rosrv
    """
    confirm_state(
        context, state, "This erases the key of the hosts' authority; all hosts need new kits afterwards"
    )
    try:
        rotate_authority(state)
    except BackupError as error:
        raise refusal([f"rosrv: {error}"]) from None
    if as_json:
        say_json({"state": str(state)})
        return
    say(
        "The key is erased. Start the appliance, which makes another; then, for each host of `rosrv host list`:"
    )
    say("    rosrv host kit NAME --token")
