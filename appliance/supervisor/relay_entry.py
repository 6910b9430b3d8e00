"""Start a relay with the limits of the configuration; the relay itself reads no configuration."""

from pathlib import Path

import msgspec

from appliance.relay.process import main as relay
from appliance.relay.relay_limits import RelayLimits


class _Section(msgspec.Struct):
    relay: RelayLimits


def main(lifeline_fd: int, index: int, config: Path) -> None:
    relay(lifeline_fd, index, limits_of(config))


def limits_of(config: Path) -> RelayLimits:
    """Return the limits in the configuration. Raises `OSError`, `msgspec.ValidationError`."""
    return msgspec.json.decode(config.read_bytes(), type=_Section).relay
