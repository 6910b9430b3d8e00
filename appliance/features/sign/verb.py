"""The command `rosrv sign`."""

from pathlib import Path
from typing import Annotated

import typer
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import load_pem_private_key, load_ssh_private_key

from appliance.base.input_files import read_given
from appliance.cli.output import Json, say_json, usage_error, write_told
from appliance.signing.site_keys import name_of, public_line
from appliance.signing.site_keys import sign as signature_of
from rosmop.tool.terminal import say

_OPENSSH = b"-----BEGIN OPENSSH PRIVATE KEY-----"


def sign(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE", help="Files whose text is signed", show_default=False)
    ],
    key: Annotated[
        Path, typer.Option(metavar="FILE", help="The private key (ssh-keygen -t ed25519 -f FILE)")
    ],
    as_json: Json = False,
) -> None:
    """Sign policies, specifications and message definitions; the signature of FILE is written to FILE.sig.

    Add the public key (KEY.pub) to `site_keys` of appliance.yaml: from then on, only signed files come into force.
    `ssh-keygen -Y sign -n rosrv -f KEY FILE` makes the same signature, and supports passphrases and ssh-agent.

    Example: rosrv sign policies/default.ini --key site
    """
    private = _private(key)
    signatures = {file: signature_of(_text(file), private) for file in files}
    line = public_line(private)
    for file, text in signatures.items():
        beside = file.with_name(f"{file.name}.sig")
        try:
            write_told(beside, text.encode())
        except OSError as error:
            raise usage_error(f"cannot write {beside}: {error.strerror}", verb="rosrv sign") from error
        if as_json:
            say_json({"file": str(file), "signature": str(beside), "key": line})
        else:
            say(f"{beside}: signed with {name_of(line)}")


def _private(file: Path) -> Ed25519PrivateKey:
    try:
        data = read_given(file)
        load = load_ssh_private_key if data.startswith(_OPENSSH) else load_pem_private_key
        key = load(data, password=None)
    except OSError as error:
        raise usage_error(f"cannot read {file}: {error.strerror}", verb="rosrv sign") from error
    except TypeError:
        why = f"{file} has a passphrase: ssh-keygen -Y sign -n rosrv -f {file} FILE asks for it and signs"
        raise usage_error(why, verb="rosrv sign") from None
    except (ValueError, UnsupportedAlgorithm):
        key = None
    if not isinstance(key, Ed25519PrivateKey):
        why = f"{file} is not a private Ed25519 key; create one: ssh-keygen -t ed25519 -f KEY"
        raise usage_error(why, verb="rosrv sign")
    return key


def _text(file: Path) -> str:
    """Read a file to sign, which must be UTF-8 with LF, as the appliance requires."""
    try:
        text = read_given(file).decode("utf-8")
    except OSError as error:
        raise usage_error(f"cannot read {file}: {error.strerror}", verb="rosrv sign") from error
    except UnicodeDecodeError:
        raise usage_error(f"{file} is not UTF-8 text", verb="rosrv sign") from None
    if "\r" in text or text.startswith("\N{ZERO WIDTH NO-BREAK SPACE}"):
        why = f"{file} has lines that end with CR LF, or a byte order mark: save it as plain UTF-8 with LF"
        raise usage_error(why, verb="rosrv sign")
    return text
