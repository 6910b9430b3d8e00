"""Reject key files that others may read."""

import stat
from pathlib import Path


class SignerKeyError(Exception):
    """A key cannot be used."""


def require_private(path: Path) -> None:
    mode = path.stat().st_mode
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise SignerKeyError(
            f"{path}: others may read this private key (mode {mode & 0o777:o});"
            " treat it as stolen, or set its mode to 600 if you know better"
        )
