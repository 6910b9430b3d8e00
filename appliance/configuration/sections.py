"""Define how a section of `appliance.yaml` is written, for the settings of the core and of features."""

import dataclasses
import ipaddress
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeVar, dataclass_transform

HOST_NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,252}[A-Za-z0-9])?")
T = TypeVar("T")
S = TypeVar("S", bound="FeatureSection")


def key(*, description: str = "", default: Any = dataclasses.MISSING, **rules: Any) -> Any:
    """Define a setting; `rules` are those of pydantic's `Field`."""
    metadata = {"description": description or None, **rules}
    if isinstance(default, list):
        metadata["json_schema_extra"] = {"default": default}
        return dataclasses.field(default_factory=lambda: list(default), metadata=metadata)
    if "default_factory" in metadata:
        return dataclasses.field(default_factory=metadata.pop("default_factory"), metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(key,))
def section(cls: type[T]) -> type[T]:
    cls.__pydantic_config__ = {"extra": "forbid"}  # type: ignore[attr-defined]  # pydantic reads this attribute
    return dataclasses.dataclass(frozen=True, kw_only=True)(cls)


def split_address(text: str) -> tuple[str, int]:
    """Parse `HOST:PORT` or `[IPv6]:PORT`. Raises `ValueError`."""
    host, colon, port = text.rpartition(":")
    if not colon or not port.isascii() or not port.isdigit() or int(port) > 65_535:
        raise ValueError(
            f"{text!r} is not HOST:PORT, for example 0.0.0.0:11311 or [::]:11311 (port 0: any free one)"
        )
    if host.startswith("[") and host.endswith("]"):
        return str(ipaddress.IPv6Address(host[1:-1])), int(port)
    if ":" in host:
        raise ValueError(f"{text!r}: an IPv6 address is written in brackets, for example [::1]:11311")
    if not HOST_NAME.fullmatch(host):
        raise ValueError(f"{host!r} is not an address of this machine")
    return host, int(port)


def split_receiver(text: str) -> tuple[str, str, int]:
    """Parse `udp|tcp|tls://ADDRESS:PORT`. Raises `ValueError`."""
    protocol, slashes, place = text.partition("://")
    example = "for example tls://10.0.0.9:6514 or udp://[fd00::9]:514"
    if not slashes or protocol not in ("udp", "tcp", "tls"):
        raise ValueError(f"{text!r} is not udp://, tcp:// or tls:// with ADDRESS:PORT, {example}")
    host, port = split_address(place)
    try:
        ipaddress.ip_address(host)
    except ValueError:
        raise ValueError(f"{host!r} is not an address; names are not looked up, {example}") from None
    if not port:
        raise ValueError(f"{text!r}: a receiver cannot have port 0, {example}")
    return protocol, host, port


def checked_receiver(text: str) -> str:
    split_receiver(text)
    return text


def checked_address(text: str) -> str:
    split_receiver(f"tcp://{text}")
    return text


def is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class FeatureSection:
    """The settings of a feature; `place` is the section's key in `appliance.yaml`, such as `audit.syslog`.

    `stored_in` names a file in the state directory that also has values of the section, or is empty.
    """

    place: ClassVar[str]
    stored_in: ClassVar[str] = ""

    @property
    def holds_records(self) -> str:
        return ""

    @property
    def files(self) -> tuple[Path, ...]:
        return ()

    @classmethod
    def with_stored(cls, _state: Path, given: dict[str, Any]) -> dict[str, Any]:
        """Add the values of `stored_in`. Raises `OSError` and `ValueError`."""
        return given

    def receivers(self) -> dict[str, tuple[str | None, str | None]]:
        return {}

    def services(self) -> tuple[str, ...]:
        return ()

    def audit_values(self) -> dict[str, str]:
        """Return the values that each start records in the audit log, by name: no secrets."""
        return {}

    def on_page(self) -> dict[str, str]:
        """Return what the console's page states, by the names of its attributes."""
        return {}


@dataclass(frozen=True)
class Sections:
    """The sections of features. A section that is not given has its defaults."""

    values: Mapping[type[FeatureSection], FeatureSection] = dataclasses.field(default_factory=dict)

    def of(self, kind: type[S]) -> S:
        value = self.values.get(kind, None) or kind()
        assert isinstance(value, kind)  # noqa: S101  the key is the value's type
        return value


DEFAULTS = Sections()
"""Every feature with its defaults."""
