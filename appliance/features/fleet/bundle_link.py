"""The messages between control and the process `bundles`."""

import msgspec

from appliance.channel.messages.message import Message
from appliance.formats.bundle_archive import BundleContents


class BundleOffered(Message):
    """A verified bundle. `path` is SITE/GROUP/VERSION.tar; `sha256` identifies its archive."""

    path: str
    sha256: str
    contents: BundleContents


class BundlePollReported(Message):
    """The state of polling, after each change and each check."""

    checked: float = 0.0
    """The time when the collector's metadata were last verified (seconds since the epoch; 0: not yet)."""
    trouble: str = ""
    rejected: bool = False
    """Whether the collector's files failed the verification."""
    offered: bool = False
    """Whether this check offered a bundle to control."""


class RefusedBundle(msgspec.Struct, frozen=True):
    """A bundle that this robot does not take."""

    path: str
    sha256: str
    reason: str


class BundleHealth(msgspec.Struct, frozen=True):
    """The last minute's denials, and monitors that fail or hold topics."""

    denials: int = 0
    failing: int = 0


class BundleStated(Message):
    """The bundles in force, under commit-confirm, and refused last."""

    in_force: str = ""
    sha256: str = ""
    trying: str = ""
    refused: RefusedBundle | None = None
    changed: bool = False
    """Whether an operator has since changed the policy, the specifications or the hosts on the robot."""
    health: BundleHealth = BundleHealth()
    waits: str = ""
    """Why the offered bundle is not tried now, although it is not refused."""


BundleLink = BundleOffered | BundlePollReported | BundleStated
