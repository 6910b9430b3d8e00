"""The section `audit.syslog` of `appliance.yaml`."""

from pathlib import Path
from typing import Annotated, ClassVar, Literal

from appliance.configuration.quantities import check
from appliance.configuration.sections import FeatureSection, checked_receiver, key, section, split_receiver


@section
class Syslog(FeatureSection):
    """The receiver of the audit log (RFC 5424), served by a process of its own; off unless `to` is given."""

    place: ClassVar[str] = "audit.syslog"
    to: Annotated[str, check(checked_receiver)] | None = key(
        default=None,
        description="udp://ADDRESS:PORT, tcp://… or tls://…: an address, so that no name server is needed",
    )
    send: Literal["all", "denials"] = key(
        default="all", description="denials: those, warnings and alarms; signed checkpoints are always sent"
    )
    facility: int = key(default=13, ge=0, le=23, description="13 is `log audit`, 10 `authpriv`, 16 `local0`")
    host_name: str | None = key(
        default=None, description="sender name in messages; default: `name`, or the machine's name"
    )
    ca: Path | None = key(
        default=None,
        description="authority of the receiver's certificate (PEM); default: those the system trusts",
    )
    name: str | None = key(
        default=None, description="name in the receiver's certificate; default: its address"
    )
    certificate: Path | None = key(
        default=None, description="client certificate, for a receiver that requires one (PEM)"
    )
    key: Path | None = key(default=None, description="key of `certificate`; readable by user rosrv-syslog")

    def __post_init__(self) -> None:
        keys = {"ca": self.ca, "name": self.name, "certificate": self.certificate, "key": self.key}
        given = [name for name, value in keys.items() if value is not None]
        if given and (self.to is None or not self.to.startswith("tls://")):
            raise ValueError(f"{', '.join(given)} would have no effect: only tls:// uses certificates")
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key must be given together")

    @property
    def destination(self) -> tuple[str, str, int]:
        return split_receiver(self.to or "")

    @property
    def files(self) -> tuple[Path, ...]:
        return tuple(filter(None, (self.ca, self.certificate, self.key)))

    def receivers(self) -> dict[str, tuple[str | None, str | None]]:
        return {"to": (self.to, self.to and self.destination[1])}
