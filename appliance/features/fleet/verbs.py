"""The commands `rosrv fleet join|leave`, which work without a running appliance."""

import hashlib
import shutil
import ssl
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from appliance.audit.log.signatures import pinned_key_path
from appliance.backup.contents import AUDIT_LOG
from appliance.base.atomic_files import write_whole
from appliance.cli.connection.target import DEFAULT_STATE, State
from appliance.cli.output import Json, say_json, usage_error
from appliance.features.fleet.connection import CollectorConnection, CollectorError, trusting_context
from appliance.formats.fleet_membership import (
    AUTHORITY,
    CERTIFICATE,
    FOLDER,
    JOIN_PATH,
    KEY,
    RECEIPT_KEY,
    SETTINGS,
    Invitation,
    JoinRequest,
    settings_of,
)
from appliance.ipsec.signer import PUBLIC_KEY_FILE
from appliance.signing.own_certificate import make_own_certificate, untimely
from appliance.supervisor.users import account_of
from rosmop.tool.terminal import refusal, say

_VERB = "rosrv fleet"
_DAYS = 825
_USED_FOR = "invitation"
"""The file of an unfinished join with the SHA-256 of its token, written after the key and the certificate."""


def join(
    file: Annotated[
        Path, typer.Argument(help="The invitation of `rosrv-fleet robot invite`; - reads standard input")
    ],
    state: State = DEFAULT_STATE,
    as_json: Json = False,
) -> None:
    """Enrol this appliance at a collector, which gets the audit log after the next start.

    The appliance makes a private key, which stays here. It sends its certificate, the public key of its audit log and
    the invitation's token. With a new invitation, a join replaces the key and the certificate. If the answer of the
    collector is lost, run the command again with the same invitation.

    Example: sudo rosrv fleet join arm7.json
    """
    invitation = _invitation(file)
    audit_key = pinned_key_path(state / AUDIT_LOG)
    try:
        if not audit_key.exists():  # until the first checkpoint is signed, only the signer has the key
            audit_key = state / "signer" / PUBLIC_KEY_FILE
        public = audit_key.read_text(encoding="ascii")
    except OSError as error:
        advice = (
            "start the appliance once before" if isinstance(error, FileNotFoundError) else "run this as root"
        )
        raise usage_error(f"{audit_key}: {error.strerror}; {advice}", _VERB) from None
    making = _unfinished(state)
    try:
        certificate = prepare_membership(making, invitation)
        request = JoinRequest(token=invitation.token, key=public, certificate=certificate)
        collector = CollectorConnection(invitation.collector, lambda: trusting_context(making / AUTHORITY))
        try:
            collector.post(JOIN_PATH.removeprefix("/"), msgspec.json.encode(request))
        finally:
            collector.close()
        shutil.rmtree(state / FOLDER, ignore_errors=True)
        making.rename(state / FOLDER)
        (state / FOLDER / _USED_FOR).unlink()
    except CollectorError as error:
        advice = "; run the command again with the same invitation" if error.status is None else ""
        raise refusal([f"{_VERB}: {error}{advice}"]) from None
    except OSError as error:
        raise refusal(
            [f"{_VERB}: {error.filename or state}: {error.strerror or error}; run this as root"]
        ) from None
    fingerprint = hashlib.sha256(ssl.PEM_cert_to_DER_cert(certificate)).hexdigest()
    if as_json:
        say_json({"robot": invitation.robot, "collector": invitation.collector, "certificate": fingerprint})
        return
    say(f"{invitation.robot} is enrolled at {invitation.collector}: certificate SHA-256 {fingerprint}")
    say("Restart the appliance: then it pushes its audit log. `rosrv status` shows the records that wait.")


def leave(state: State = DEFAULT_STATE, as_json: Json = False) -> None:
    """Forget the collector of `rosrv fleet join`. The collector keeps everything that it received.

    Example: sudo rosrv fleet leave
    """
    if not (state / FOLDER).is_dir():
        raise usage_error(
            f"{state} has no membership of `rosrv fleet join`; name the state directory that has one with --state",
            _VERB,
        )
    try:
        shutil.rmtree(_unfinished(state), ignore_errors=True)
        shutil.rmtree(state / FOLDER)
    except OSError as error:
        raise usage_error(f"{error.filename}: {error.strerror}; run this as root", _VERB) from None
    if as_json:
        say_json({"left": str(state / FOLDER)})
        return
    say("If appliance.yaml has a section `fleet`, remove it: the appliance would not start.")
    say("Restart the appliance: then it pushes nothing. On the collector: rosrv-fleet robot remove NAME")


def _invitation(file: Path) -> Invitation:
    try:
        data = Path("/dev/stdin" if str(file) == "-" else file).read_bytes()
        return msgspec.json.decode(data, type=Invitation)
    except OSError as error:
        raise usage_error(f"{file}: {error.strerror}", _VERB) from None
    except ValueError as error:
        raise usage_error(
            f"{file} is not an invitation of `rosrv-fleet robot invite`: {error}", _VERB
        ) from None


def _unfinished(state: Path) -> Path:
    return state / f"{FOLDER}.new"


def prepare_membership(folder: Path, invitation: Invitation) -> str:
    """Write the files of the membership; return the certificate (PEM).

    The key and the certificate of an earlier try with this token are kept: the collector may have enrolled them.

    """
    token = hashlib.sha256(invitation.token.encode()).hexdigest()
    if not _is_for(folder, token):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        folder.chmod(0o755)
        key, certificate = make_own_certificate(invitation.robot, _DAYS)
        # The two processes that speak to the collector read the key: one as its user, one as its group.
        owner = account_of("rosrv-fleet").uid, account_of("rosrv-bundles").gid
        write_whole(folder / KEY, key, 0o640, owner)
        write_whole(folder / CERTIFICATE, certificate, 0o644)
        write_whole(folder / _USED_FOR, token.encode(), 0o644)
    write_whole(folder / AUTHORITY, invitation.authority.encode(), 0o644)
    write_whole(folder / RECEIPT_KEY, invitation.receipt_key.encode(), 0o644)
    settings = msgspec.json.format(msgspec.json.encode(settings_of(invitation)))
    write_whole(folder / SETTINGS, settings, 0o644)
    return (folder / CERTIFICATE).read_text(encoding="ascii")


def _is_for(folder: Path, token: str) -> bool:
    """Return whether the folder was made with this token, and its certificate is now valid.

    An invalid certificate was made before the clock was corrected, so no collector has enrolled it.
    """
    try:
        same = (folder / _USED_FOR).read_text(encoding="ascii") == token
        return same and not untimely((folder / CERTIFICATE).read_bytes(), "this machine")
    except (FileNotFoundError, ValueError):
        return False
