"""Starts a relay with the limits of the configuration; the relay itself reads no configuration."""

from pathlib import Path

import msgspec

from appliance.relay.bounds import Limits
from appliance.relay.process import main as relay


class _Section(msgspec.Struct):
    """What of the settings is read here, as the supervisor has written it; a relay takes no part in the rest."""

    relay: Limits


def main(lifeline_fd: int, index: int, config: Path) -> None:
    """Run relay `index` until the supervisor ends it."""
    relay(lifeline_fd, index, limits_of(config))


def limits_of(config: Path) -> Limits:
    """The limits that the `relay` section sets; the others keep their defaults.

    Raises `OSError`, `msgspec.ValidationError`.
    """
    return msgspec.json.decode(config.read_bytes(), type=_Section).relay
