"""Starts a relay with the limits of the configuration; the relay itself reads no configuration."""

from dataclasses import asdict, replace
from pathlib import Path

from appliance.config import Settings, load_resolved
from appliance.relay.limits import Limits
from appliance.relay.process import main as relay


def main(lifeline_fd: int, index: int, config: Path) -> None:
    """Run relay `index` until the supervisor ends it."""
    relay(lifeline_fd, index, limits_of(load_resolved(config)))


def limits_of(settings: Settings) -> Limits:
    """The limits that the `relay` section sets; the others keep their defaults."""
    return replace(Limits(), **asdict(settings.relay))
