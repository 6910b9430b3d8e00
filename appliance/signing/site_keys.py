"""Sign texts, and verify signatures with the keys in the site's configuration, in OpenSSH's format
(PROTOCOL.sshsig).

The public key inside the signature file only selects one of the configured keys; it is not trusted. Without a
configured key, no signature is required or checked.
"""

import base64
import binascii
import hashlib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from appliance.base.input_files import open_given

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

_NAMESPACE = b"rosrv"
_ED25519 = b"ssh-ed25519"
_MAGIC = b"SSHSIG"
_HASHES = (b"sha512", b"sha256")  # the hashes that SSHSIG allows
_ARMOUR = re.compile(
    r"\s*+-----BEGIN SSH SIGNATURE-----\n([A-Za-z0-9+/=\n]{1,4000})\n-----END SSH SIGNATURE-----\s*+"
)
_LONGEST = 8192  # characters of a signature file
_HOW = "sign it (rosrv sign FILE --key KEY) and leave FILE.sig beside it, or send that along"


class UnsignedError(Exception):
    """A text has no valid signature of the site."""


def checked_key(line: str) -> str:
    """Return the line if it is `ssh-ed25519 BASE64 COMMENT`. Raises `ValueError` with the reason."""
    _public(line)
    return line


def name_of(line: str) -> str:
    """Return the fingerprint, as `ssh-keygen -l` prints it, and the comment."""
    digest = hashlib.sha256(_wire(_ED25519, _public(line))).digest()
    comment = " ".join(line.split()[2:])
    return f"SHA256:{base64.b64encode(digest).decode().rstrip('=')}" + (f" ({comment})" if comment else "")


def read_signature(file: Path) -> str:
    try:
        with open_given(file.with_name(f"{file.name}.sig")) as opened:
            return opened.read(_LONGEST).decode("ascii", "replace")
    except OSError:
        return ""


def signer(keys: Sequence[str], text: str, signature: str) -> str:
    """Return the name of the key that signed; empty if no keys are configured. Raises `UnsignedError`."""
    if not keys:
        return ""
    from cryptography.exceptions import InvalidSignature  # noqa: PLC0415  every verb that reads settings loads this file
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey  # noqa: PLC0415  as above

    if not signature:
        raise UnsignedError(f"it has no signature of the site (site_keys in appliance.yaml): {_HOW}")
    try:
        key, namespace, hashed, raw = _read(signature)
    except ValueError:
        text = "its signature is not one of `rosrv sign` or `ssh-keygen -Y sign` with an Ed25519 key"
        raise UnsignedError(f"{text}: {_HOW}") from None
    if namespace != _NAMESPACE:
        raise UnsignedError(
            f"its signature is for {namespace!r}, not for rosrv (ssh-keygen -Y sign -n rosrv)"
        )
    line = next((line for line in keys if _public(line) == key), None)
    if line is None:
        name = name_of(f"ssh-ed25519 {base64.b64encode(_wire(_ED25519, key)).decode()}")
        raise UnsignedError(f"it is signed with {name}, which is none of site_keys in appliance.yaml: {_HOW}")
    try:
        Ed25519PublicKey.from_public_bytes(key).verify(raw, _message(text, hashed))
    except InvalidSignature:
        changed = f"it is not the text that {name_of(line)} signed"
        raise UnsignedError(f"{changed} (lines must end with LF, without a BOM): {_HOW}") from None
    return name_of(line)


def sign(text: str, key: "Ed25519PrivateKey") -> str:
    """Return the signature, as `ssh-keygen -Y sign -n rosrv` writes it."""
    raw = key.sign(_message(text, _HASHES[0]))
    public = _wire(_ED25519, key.public_key().public_bytes_raw())
    fields = _wire(public, _NAMESPACE, b"", _HASHES[0], _wire(_ED25519, raw))
    blob = base64.b64encode(_MAGIC + (1).to_bytes(4) + fields).decode()
    lines = [blob[place : place + 70] for place in range(0, len(blob), 70)]
    return "\n".join(["-----BEGIN SSH SIGNATURE-----", *lines, "-----END SSH SIGNATURE-----", ""])


def public_line(key: "Ed25519PrivateKey") -> str:
    return f"ssh-ed25519 {base64.b64encode(_wire(_ED25519, key.public_key().public_bytes_raw())).decode()}"


def _public(line: str) -> bytes:
    words = line.split()
    try:
        kind, key = _strings(base64.b64decode(words[1], validate=True), 2)
    except (ValueError, IndexError):
        kind, key = b"", b""
    if words[:1] != ["ssh-ed25519"] or kind != _ED25519 or len(key) != 32:
        raise ValueError(
            "is not `ssh-ed25519 BASE64 COMMENT`, the line that ssh-keygen -t ed25519 writes to KEY.pub"
        )
    return key


def _read(signature: str) -> tuple[bytes, bytes, bytes, bytes]:
    match = _ARMOUR.fullmatch(signature.replace("\r\n", "\n"))
    try:
        blob = base64.b64decode(match[1].replace("\n", ""), validate=True) if match else b""
    except binascii.Error as error:
        raise ValueError("not base64") from error
    if blob[:10] != _MAGIC + (1).to_bytes(4):
        raise ValueError("not SSHSIG, version 1")
    public, namespace, _reserved, hashed, signed = _strings(blob[10:], 5)
    (kind, key), (signed_kind, raw) = _strings(public, 2), _strings(signed, 2)
    if (
        (kind, signed_kind) != (_ED25519, _ED25519)
        or (len(key), len(raw)) != (32, 64)
        or hashed not in _HASHES
    ):
        raise ValueError("not Ed25519")
    return key, namespace, hashed, raw


def _message(text: str, hashed: bytes) -> bytes:
    digest = hashlib.new(hashed.decode(), text.encode("utf-8", "surrogateescape")).digest()
    return _MAGIC + _wire(_NAMESPACE, b"", hashed, digest)


def _wire(*strings: bytes) -> bytes:
    return b"".join(len(string).to_bytes(4) + string for string in strings)


def _strings(data: bytes, count: int) -> list[bytes]:
    """Return the `count` strings; raise `ValueError` if there is another number."""
    strings = []
    while data:
        length = int.from_bytes(data[:4])
        if len(data) < 4 + length:
            raise ValueError("cut off")
        strings.append(data[4 : 4 + length])
        data = data[4 + length :]
    if len(strings) != count:
        raise ValueError("something else")
    return strings
