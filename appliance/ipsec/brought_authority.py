"""Use an authority that was brought from another machine, with a key that a passphrase encrypts.

Without the passphrase, the signer uses its own authority.
"""

from pathlib import Path

from appliance.ipsec.authority_key import Kind, SignerKeyError, is_encrypted, require_private
from appliance.ipsec.certificate_authority import KEY_FILE, CertificateAuthority

FOLDER = "joined"  # of the signer's directory


def open_authority(directory: Path, kind: Kind, passphrase: bytes | None) -> tuple[CertificateAuthority, str]:
    """Return the brought authority, or the appliance's own with the reason. Raises `SignerKeyError` and `OSError`."""
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
