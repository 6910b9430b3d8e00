"""Bring the encrypted key of an authority to the other one of two appliances, and use it there.

Only a key that the passphrase encrypts is brought. The other appliance keeps it beside its own authority, and uses it
instead once it has the same passphrase. Until then, or with a wrong passphrase, it starts without it.
"""

import contextlib
import os
from pathlib import Path

import msgspec

from appliance.base.atomic_files import write_whole
from appliance.ipsec.authority_key import Kind, is_encrypted
from appliance.ipsec.certificate_authority import CERTIFICATE_FILE, KEY_FILE, CertificateAuthority
from appliance.ipsec.key_files import SignerKeyError, require_private

FOLDER = "joined"  # of the signer's directory


class SealedAuthority(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An authority's certificate (PEM), and its private key as PEM that a passphrase encrypts."""

    certificate: str
    key: str


def sealed_authority(signer: Path) -> SealedAuthority | None:
    """Return the authority in the signer's directory; None without an encrypted key. Raises `OSError`."""
    path = signer / KEY_FILE
    key = path.read_bytes() if path.exists() else b""
    if not is_encrypted(key):
        return None
    return SealedAuthority((signer / CERTIFICATE_FILE).read_text(encoding="ascii"), key.decode("ascii"))


def keep_sealed(signer: Path, sealed: SealedAuthority, owner: tuple[int, int] | None) -> None:
    """Store the other appliance's authority in the signer's directory, which is created if missing.

    `owner` is the user and group of the signer; None: the caller's. Raises `ValueError` if the key is not encrypted,
    and `OSError`.
    """
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


def open_authority(directory: Path, kind: Kind, passphrase: bytes | None) -> tuple[CertificateAuthority, str]:
    """Return the joined authority if its key can be used, else the appliance's own, with the reason (empty: none).

    Raises `SignerKeyError` and `OSError` if the appliance's own authority cannot be used.
    """
    own, folder = CertificateAuthority(directory, kind, passphrase), directory / FOLDER
    if not (folder / KEY_FILE).exists():
        return own, ""
    try:
        require_encrypted(folder / KEY_FILE)
        return CertificateAuthority(folder, kind, passphrase), ""
    except (SignerKeyError, OSError) as error:
        return own, str(error)


def require_encrypted(path: Path) -> None:
    """Raise `SignerKeyError` for a key that is not encrypted, or that others may read."""
    require_private(path)
    if not is_encrypted(path.read_bytes()):
        raise SignerKeyError(
            f"{path}: the key is not encrypted, so it is not used: run `rosrv standby join` again"
        )
