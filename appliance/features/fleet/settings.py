"""The section `fleet` of `appliance.yaml`."""

import re
from pathlib import Path
from typing import Annotated, Any, ClassVar

from appliance.configuration.quantities import check, rules
from appliance.configuration.sections import FeatureSection, key, section, split_receiver
from appliance.formats.fleet_membership import FOLDER, SETTINGS, joined_settings

PUSHER, POLLER = "fleet", "bundles"

_WORD = re.compile(r"[a-z0-9][a-z0-9-]{0,62}")


def split_collector(text: str) -> tuple[str, int]:
    protocol, _slashes, place = text.partition("://")
    if protocol != "https" or place.endswith("/"):
        raise ValueError(f"{text!r} is not https://ADDRESS:PORT, for example https://10.0.0.9:8444")
    _protocol, host, port = split_receiver(f"tls://{place}")
    return host, port


def _check_collector(text: str) -> str:
    split_collector(text)
    return text


def _check_word(text: str) -> str:
    if text and not _WORD.fullmatch(text):
        raise ValueError(
            f"{text!r} is not a name of lower-case letters, digits and -, for example arm-robots"
        )
    return text


@section
class Bundles:
    """Policy, specifications and hosts from the fleet's signed bundles; off unless `root` is given."""

    root: Path | None = key(
        default=None, description="the trusted root metadata (root.json) that the fleet's operator gives out"
    )
    site: Annotated[str, check(_check_word)] = key(
        default="", description="the site that this robot belongs to"
    )
    group: Annotated[str, check(_check_word)] = key(
        default="", description="the robot group: the robots that get the same bundles"
    )
    interval: Annotated[float, rules(ge=1, le=86_400, allow_inf_nan=False)] = key(
        default=300.0,
        description="seconds between two polls; an event of the collector makes the next one earlier",
    )
    confirm_seconds: Annotated[float, rules(ge=1, le=3600, allow_inf_nan=False)] = key(
        default=30.0,
        description="for which a new bundle must stay healthy; otherwise it is rolled back automatically",
    )
    wait_for_order: bool = key(
        default=False,
        description="a new bundle waits until `rosrv fleet take`, for example until the robot stands still",
    )

    def __post_init__(self) -> None:
        if self.root is not None and not (self.site and self.group):
            raise ValueError("root needs site and group: the bundles are signed for one group of one site")


@section
class Fleet(FeatureSection):
    """A collector of many appliances: it receives the audit log's segments, and provides bundles. Off by default.

    `rosrv fleet join` gives `collector`, `robot` and the files; keys here override them.
    """

    collector: Annotated[str, check(_check_collector)] | None = key(
        default=None, description="https://ADDRESS:PORT: an address, so that no name server is needed"
    )
    name: str | None = key(
        default=None, description="name in the collector's certificate; default: its address"
    )
    ca: Path | None = key(default=None, description="authority of the collector's certificate (PEM)")
    certificate: Path | None = key(
        default=None, description="client certificate, enrolled at the collector (PEM)"
    )
    receipt_key: Path | None = key(
        default=None,
        description="public key of the collector's receipts (PEM); `rosrv-fleet init` prints its file."
        " With it, sealed segments are pushed",
    )
    retention_waits: bool = key(
        default=False,
        description="records that are older than `audit.retention_days` stay until the collector has them;"
        " `audit.retention_bytes` and a full disk remove them nevertheless",
    )
    robot: str = key(
        default="",
        pattern=r"^([a-z0-9][a-z0-9._-]{0,62})?$",
        description="this robot's name at the collector (`rosrv-fleet robot add`); bundles need it",
    )
    key: Path | None = key(
        default=None, description="key of `certificate`; readable by users rosrv-fleet and rosrv-bundles"
    )
    bundles: Bundles = Bundles()

    place: ClassVar[str] = "fleet"
    stored_in: ClassVar[str] = f"{FOLDER}/{SETTINGS}"

    def __post_init__(self) -> None:
        if self.collector is None:
            files = (self.ca, self.certificate, self.key, self.receipt_key)
            if any((self.name, *files, self.robot, self.retention_waits, self.bundles != Bundles())):
                raise ValueError(
                    "the section has no effect without a collector: remove it, name a `collector`,"
                    " or run 'rosrv fleet join'"
                )
            return
        needed: dict[str, Path | str | None] = {
            "ca": self.ca,
            "certificate": self.certificate,
            "key": self.key,
        }
        if self.bundles.root is not None:
            needed |= {"robot": self.robot}
        missing = [name for name, value in needed.items() if not value]
        if missing:
            raise ValueError(f"{', '.join(missing)} must be given with collector")
        if self.receipt_key is None and self.bundles.root is None:
            raise ValueError(
                "collector needs receipt_key, to push segments, or bundles.root, to take bundles"
            )
        if self.receipt_key is None and self.retention_waits:
            raise ValueError("retention_waits has no effect without receipt_key")

    @property
    def destination(self) -> tuple[str, int]:
        return split_collector(self.collector or "")

    @property
    def connection(self) -> tuple[str, Path, Path, Path, str | None]:
        assert self.collector and self.ca and self.certificate and self.key  # noqa: S101  checked above
        return self.collector, self.ca, self.certificate, self.key, self.name

    @property
    def files(self) -> tuple[Path, ...]:
        return tuple(filter(None, (self.ca, self.certificate, self.key, self.receipt_key, self.bundles.root)))

    @property
    def holds_records(self) -> str:
        return "retention_waits" if self.retention_waits else ""

    def receivers(self) -> dict[str, tuple[str | None, str | None]]:
        return {"collector": (self.collector, self.collector and self.destination[0])}

    @classmethod
    def with_stored(cls, state: Path, given: dict[str, Any]) -> dict[str, Any]:
        """Return the keys in `given`, with those of `rosrv fleet join` unless `given` names a collector."""
        joined = {} if given.get("collector") else joined_settings(state)
        if not joined:
            return given
        section, bundles = joined | given, given.get("bundles", {})
        if "bundles" in joined and isinstance(bundles, dict):
            section["bundles"] = joined["bundles"] | bundles
        return section
