"""Bring the key of an authority, encrypted with a passphrase, to the other appliance.

The other appliance keeps it beside its own authority (`ipsec/brought_authority.py`).
"""

import contextlib
import os
from pathlib import Path

import msgspec

from appliance.base.atomic_files import write_whole
from appliance.ipsec.authority_key import is_encrypted
from appliance.ipsec.brought_authority import FOLDER
from appliance.ipsec.certificate_authority import CERTIFICATE_FILE, KEY_FILE


class SealedAuthority(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An authority's certificate, and its private key encrypted with a passphrase (both PEM)."""

    certificate: str
    key: str


def sealed_authority(signer: Path) -> SealedAuthority | None:
    path = signer / KEY_FILE
    key = path.read_bytes() if path.exists() else b""
    if not is_encrypted(key):
        return None
    return SealedAuthority((signer / CERTIFICATE_FILE).read_text(encoding="ascii"), key.decode("ascii"))


def keep_sealed(signer: Path, sealed: SealedAuthority, owner: tuple[int, int] | None) -> None:
    if not is_encrypted(sealed.key.encode()):
        raise ValueError("the key of the authority is not encrypted: set ipsec.ca_passphrase_file there")
    folder = signer / FOLDER
    for made in (signer, folder):
        with contextlib.suppress(FileExistsError):
            made.mkdir(mode=0o700)
            if owner is not None:
                os.chown(made, *owner)
    write_whole(folder / CERTIFICATE_FILE, sealed.certificate.encode(), 0o644, owner)
    write_whole(folder / KEY_FILE, sealed.key.encode(), 0o600, owner)
