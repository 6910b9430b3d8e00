"""The configuration of the appliance: every key with its default, as `appliance.yaml` spells it.

`appliance.config_sources` reads the file, the environment and the flags into it; the supervisor writes
the result to `run/config.json` in the state directory, from where the other processes load it. A key is
here because something reads it.
"""

import ipaddress
import os
import re
from ipaddress import IPv4Network
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ByteSize,
    ConfigDict,
    Field,
    IPvAnyAddress,
    IPvAnyNetwork,
    ValidationInfo,
    field_validator,
    model_validator,
)

from appliance.site_keys import checked_key

_NODE_NAME = re.compile(r"(/[A-Za-z][A-Za-z0-9_]{0,99}){1,5}")
_HOST_NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,252}[A-Za-z0-9])?")

Seconds = Annotated[float, Field(gt=0, le=86_400 * 365, allow_inf_nan=False)]
Count = Annotated[int, Field(gt=0)]
Size = Annotated[ByteSize, Field(gt=0)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


def split_address(text: str) -> tuple[str, int]:
    """`HOST:PORT` or `[IPv6]:PORT` as host and port. Raises `ValueError`, which says what is wrong."""
    host, colon, port = text.rpartition(":")
    if not colon or not port.isascii() or not port.isdigit() or int(port) > 65_535:
        raise ValueError(
            f"{text!r} is not HOST:PORT, for example 0.0.0.0:11311 or [::]:11311 (port 0: any free one)"
        )
    if host.startswith("[") and host.endswith("]"):
        return str(ipaddress.IPv6Address(host[1:-1])), int(port)
    if ":" in host:
        raise ValueError(f"{text!r}: an IPv6 address is written in brackets, for example [::1]:11311")
    if not _HOST_NAME.fullmatch(host):
        raise ValueError(f"{host!r} is not an address of this machine")
    return host, int(port)


def split_receiver(text: str) -> tuple[str, str, int]:
    """`udp|tcp|tls://ADDRESS:PORT` as protocol, address and port. Raises `ValueError`."""
    protocol, slashes, place = text.partition("://")
    example = "for example tls://10.0.0.9:6514 or udp://[fd00::9]:514"
    if not slashes or protocol not in ("udp", "tcp", "tls"):
        raise ValueError(f"{text!r} is not udp://, tcp:// or tls:// with ADDRESS:PORT, {example}")
    host, port = split_address(place)
    try:
        ipaddress.ip_address(host)
    except ValueError:
        raise ValueError(f"{host!r} is no address; names are not looked up, {example}") from None
    if not port:
        raise ValueError(f"{text!r}: port 0 is no receiver's, {example}")
    return protocol, host, port


def _checked_receiver(text: str) -> str:
    split_receiver(text)
    return text


def _checked_address(text: str) -> str:
    split_address(text)
    return text


def _checked_endpoint(text: str) -> str:
    example = "for example 192.168.1.20 or robot.example.org"
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        if _HOST_NAME.fullmatch(text) is None or text.replace(".", "").isdecimal():
            raise ValueError(
                f"{text!r} is neither an address nor a name (no port, no brackets), {example}"
            ) from None
        if is_loopback(text):
            raise ValueError(
                f"{text} is this machine only, where no other host reaches it, {example}"
            ) from None
        return text
    if address.is_loopback or address.is_unspecified or address.is_multicast or address.is_link_local:
        raise ValueError(f"{text} is no address at which other hosts reach the appliance, {example}")
    return str(address)


def _none_if_empty(value: object) -> object:
    return None if value == "" else value  # what compose hands on of a variable that is not set


def _checked_name(text: str) -> str:
    if _NODE_NAME.fullmatch(text) is None:
        raise ValueError(f"{text!r} is not a global node name, for example /rosrv")
    return text


def _off_as_text(value: object) -> object:
    return "off" if value is False else value  # YAML reads a bare `off` as false


def _checked_api(text: str) -> str:
    return text if text == "off" else _checked_address(text)


def is_loopback(host: str) -> bool:
    """Whether a host, as configured, is this machine only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class Advertisement(_Section):
    """The address that nodes of one network are told the appliance has."""

    network: IPvAnyNetwork
    address: IPvAnyAddress


class Limits(_Section):
    """What RVMaster and the node faces accept; the defaults are beyond a large robot."""

    body_bytes: Size = Field(default=ByteSize(16 << 20), description="body of a request")
    elements: Count = Field(default=1_000_000, description="values in one request")
    nesting: Count = Field(default=100, description="arrays and structs inside each other")
    string_bytes: Size = Field(default=ByteSize(8 << 20), description="one string")
    multicall_parts: Count = Field(default=100_000, description="calls in one system.multicall")
    parameter_bytes: Size = Field(
        default=ByteSize(64 << 20),
        description="all parameters together, as they are sent; one host may set half of them",
    )
    header_bytes: Size = Field(default=ByteSize(64 << 10), description="request line and headers")
    header_seconds: Seconds = Field(default=10, description="until request line and headers must be there")
    idle_seconds: Seconds = Field(default=300, description="a kept-alive connection without a request")
    connections_per_host: Count = 512
    connections: Count = Field(default=4096, description="of all hosts")
    nodes_per_host: Count = 500
    topics_per_host: Count = 5000
    node_call_seconds: Seconds = Field(default=3, description="a call that the appliance makes to a node")
    offload_bytes: Size = Field(
        default=ByteSize(256 << 10), description="larger bodies are parsed outside the event loop"
    )


class Syslog(_Section):
    """Where the audit log is forwarded to (RFC 5424), in a process of its own; off unless `to` is given."""

    to: Annotated[str, AfterValidator(_checked_receiver)] | None = Field(
        default=None,
        description="udp://ADDRESS:PORT, tcp://… or tls://…: an address, so that nothing is asked of a name server",
    )
    send: Literal["all", "denials"] = Field(
        default="all", description="denials: those, warnings and alarms; signed checkpoints are always sent"
    )
    format: Literal["fields", "ocsf"] = Field(
        default="fields",
        description="fields: as parameters of RFC 5424, the reason as text; ocsf: the text is an event of OCSF 1.6.0",
    )
    facility: int = Field(
        default=13, ge=0, le=23, description="13 is `log audit`, 10 `authpriv`, 16 `local0`"
    )
    host_name: str | None = Field(
        default=None, description="the name messages come from; the machine's unless it is given"
    )
    ca: Path | None = Field(
        default=None,
        description="authority of the receiver's certificate (PEM); those the system trusts if not given",
    )
    name: str | None = Field(
        default=None, description="name in the receiver's certificate; its address unless it is given"
    )
    certificate: Path | None = Field(
        default=None, description="for a receiver that wants to know who sends (PEM)"
    )
    key: Path | None = Field(default=None, description="of `certificate`; readable by user rosrv-syslog")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        given = [name for name in ("ca", "name", "certificate", "key") if getattr(self, name) is not None]
        if given and (self.to is None or not self.to.startswith("tls://")):
            raise ValueError(f"{', '.join(given)} would do nothing: only tls:// has certificates")
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key go together")
        return self

    @property
    def destination(self) -> tuple[str, str, int]:
        """`to` as protocol, address and port; only where it is given."""
        return split_receiver(self.to or "")


class Audit(_Section):
    """The audit log."""

    durability: Literal["strict", "batched"] = Field(
        default="batched", description="strict: on disk before the answer; batched: within 50 ms"
    )
    on_audit_failure: Literal["deny", "allow"] = Field(
        default="deny", description="what is answered while the log cannot be written"
    )
    checkpoint_records: Count = Field(default=1000, description="records after which a checkpoint is signed")
    checkpoint_seconds: Seconds = Field(default=60, description="seconds after which a checkpoint is signed")
    retention_days: Seconds | None = Field(
        default=None, description="older records are removed, and that is recorded"
    )
    retention_bytes: Annotated[ByteSize, Field(ge=1 << 20)] | None = Field(
        default=None, description="beyond this size the oldest records are removed"
    )
    reserve_bytes: Annotated[ByteSize, Field(ge=1 << 20)] = Field(
        default=ByteSize(64 << 20),
        description="of the disk: below it who causes many records is slowed more, so that the others are recorded",
    )
    syslog: Syslog = Syslog()


class Liveness(_Section):
    """When a node counts as gone; all in seconds."""

    interval: Seconds = Field(default=5, description="between two looks at a node")
    silent: Seconds = Field(default=20, description="without an answer until the node is unregistered")
    shadow: Seconds = Field(default=600, description="for which a gone node's registration can come back")


class Relay(_Section):
    """What the relay accepts and holds; each key is a field of `appliance.relay.limits.Limits`."""

    connections: Count = Field(default=16_384, description="of all hosts")
    connections_per_host: Count = 8_192
    header_bytes: Size = Field(default=ByteSize(64 << 10), description="TCPROS connection header")
    header_seconds: Seconds = Field(default=10, description="until the connection header must be there")
    message_bytes: Size = Field(default=ByteSize(256 << 20), ge=1 << 20, description="one message")
    queue_messages: Count = Field(default=1000, description="messages waiting for one subscriber")
    queue_bytes: Size = Field(default=ByteSize(64 << 20), description="bytes waiting for one subscriber")
    memory_bytes: Size = Field(
        default=ByteSize(1 << 30),
        description="of one relay: half for unfinished messages, a quarter each for queues and latched ones",
    )


class RecorderRules(_Section):
    """The flight recorder: what was said before and after something happened. Off, for it keeps what a robot says."""

    enabled: bool = Field(default=False, description="whether anything is recorded")
    memory: Annotated[ByteSize, Field(ge=16 << 20)] = Field(
        default=ByteSize(64 << 20),
        description="of all relays together, for what they received last; it survives them",
    )
    before: Annotated[Seconds, Field(le=3600)] = Field(default=60, description="seconds before what happened")
    after: Annotated[Seconds, Field(le=3600)] = Field(default=10, description="seconds after it")
    longest: Annotated[Seconds, Field(le=3600)] = Field(
        default=600, description="seconds of one recording, however much happens in it"
    )
    topics: list[str] = Field(default=["/*"], description="what is recorded: names, `*` is anything")
    never: list[str] = Field(
        default=[
            "sensor_msgs/Image",
            "sensor_msgs/CompressedImage",
            "theora_image_transport/Packet",
            "audio_common_msgs/AudioData",
            "audio_common_msgs/AudioDataStamped",
        ],
        description="names or types that are never recorded; unless it is given: cameras and microphones",
    )
    triggers: list[Literal["drop", "change", "verdict", "fault", "denial", "alarm", "service"]] = Field(
        default=["drop", "verdict", "fault", "alarm", "service"],
        description="what begins a recording, besides an operator; service: a node's call, if the policy lets it",
    )
    per_hour: Count = Field(default=6, description="recordings that triggers of one kind may begin")
    disk: Annotated[ByteSize, Field(ge=64 << 20)] = Field(
        default=ByteSize(2 << 30), description="of all recordings; one has an eighth of it at most"
    )
    days: Seconds | None = Field(default=30, description="after which a recording is removed; null: never")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.longest < self.before + self.after:
            raise ValueError(f"longest is {self.longest:g}, and before and after are more together")
        return self


class Firewall(_Section):
    """The firewall around the ROSMaster (isolation netns and container)."""

    backend: Literal["auto", "iptables", "nft"] = Field(
        default="auto", description="auto: what the kernel really enforces"
    )


class Ipsec(_Section):
    """The tunnels of trusted hosts; they are opened when the first host is enrolled."""

    pool: IPv4Network = Field(
        default=IPv4Network("10.113.11.0/24"),
        description="virtual addresses of the hosts in tunnels; the first one is the appliance's",
    )

    endpoint: Annotated[
        Annotated[str, AfterValidator(_checked_endpoint)] | None, BeforeValidator(_none_if_empty)
    ] = Field(
        default=None,
        description="address or name at which hosts reach the appliance from outside, for their kits;"
        " found out unless it is given here or with --appliance",
    )

    ca: Literal["ecdsa", "ed25519"] = Field(
        default="ecdsa",
        description="kind of the authority's key, which is made at the first start: P-384, or Ed25519",
    )
    ca_passphrase_file: Path | None = Field(
        default=None,
        description="file, readable by root only, whose first line encrypts the authority's key;"
        " also ROSRV_CA_PASSPHRASE_FILE",
    )

    @field_validator("pool", mode="before")
    @classmethod
    def _is_ipv4(cls, pool: object) -> object:
        if isinstance(pool, str) and ":" in pool:
            raise ValueError(
                f"{pool}: virtual addresses are IPv4, which every ROS 1 node speaks; take a private /24"
            )
        return pool

    @field_validator("pool")
    @classmethod
    def _room_for_hosts(cls, pool: IPv4Network) -> IPv4Network:
        if not 16 <= pool.prefixlen <= 29:
            raise ValueError(f"{pool} must have a prefix length from 16 to 29")
        return pool


class ApiLimits(_Section):
    """What the REST interface accepts; beyond it a client is told to come back later."""

    body_bytes: Size = Field(default=ByteSize(1 << 20), description="body of a request")
    requests_per_second: Seconds = Field(default=50, description="of one host, on average")
    burst: Count = Field(default=200, description="requests of one host at once")
    failures_per_minute: Count = Field(default=20, description="requests of one host without a good token")
    connections: Count = Field(default=512, description="of all hosts")
    connections_per_host: Count = 64
    header_seconds: Seconds = Field(default=10, description="until the request's headers must be there")
    streams: Count = Field(default=16, description="clients that follow the audit log, at once")


def relays_for_this_machine() -> int:
    """How many relay processes there are unless it is configured: half of the cores, 1 to 4."""
    return max(1, min(4, (os.cpu_count() or 1) // 2))


class Settings(_Section):
    """All of it."""

    policy: Path = Field(
        default=Path("policies/default.ini"), description="the access policy; read again on reload"
    )
    monitors: Path | None = Field(
        default=None, description="folder of specifications (.rv) of monitors; read again on reload"
    )
    enable: str = Field(
        default="all", description="monitors enabled at start unless they were switched: all, none, or NAME,…"
    )
    on_fault: Literal["drop", "pass"] = Field(
        default="drop", description="what becomes of a message at which an action of a monitor faults"
    )
    slices: int = Field(
        default=100_000,
        ge=1,
        le=1_000_000,
        description="slices of a parametric specification: bindings that are monitored at a time, about 700 bytes each",
    )
    publish_as: Annotated[str, AfterValidator(_checked_name)] = Field(
        default="/rosrv", description="the node name under which monitors publish"
    )
    monitors_on_rosout: bool = Field(
        default=False,
        description="put output, verdicts and faults of monitors on /rosout, too (the audit log always has them)",
    )
    hide_publisher: bool = Field(
        default=False, description="leave out what monitors publish in getSystemState"
    )
    site_keys: list[Annotated[str, AfterValidator(checked_key)]] = Field(
        default=[],
        description="public keys (`ssh-ed25519 BASE64 COMMENT`); with any, a policy or specification that none of them"
        " signed is refused",
    )
    state: Path = Field(
        default=Path("/var/lib/rosrv"), description="directory of everything that must survive a restart"
    )
    listen: Annotated[str, AfterValidator(_checked_address)] = Field(
        default="0.0.0.0:11311",
        description="where nodes find their master",
    )
    rosmaster_port: int = Field(
        # Not 11411, where rosserial's TCP server listens, and below the ports the kernel gives to clients.
        default=12311,
        ge=0,
        le=65_535,
        description="loopback port of the hidden ROSMaster; 0: any free one",
    )
    isolation: Literal["container", "netns", "none"] = Field(
        default="netns", description="where the appliance lives; none: no firewall, for development only"
    )
    relaying: Literal["all", "monitored"] = Field(
        default="all",
        description="topics and services that go through the relay; `monitored` (those in [Monitor]) is no boundary",
    )
    mediation: Literal["full", "monitored"] = Field(
        default="full",
        description="`monitored` tells nodes each other's real URIs; needs relaying: monitored",
    )
    api: Annotated[str, BeforeValidator(_off_as_text), AfterValidator(_checked_api)] = Field(
        default="127.0.0.1:8443",
        description="HOST:PORT of REST, or off; unless it is given here, another free port when this one is taken",
    )
    api_tls: bool = Field(default=True, description="off: clear text, on a loopback address only")
    api_require_proof: bool = Field(
        default=False,
        description="on: changes over REST are made for signed requests only (docs/rest.md), never for a bare token",
    )
    api_networks: list[IPvAnyNetwork] = Field(
        default=[], description="who may connect to REST besides this machine (the firewall's rule)"
    )
    api_published: bool = Field(
        default=True,
        description="off: other machines cannot reach the port although it listens (a container that publishes it on"
        " loopback), so that hosts cannot enrol themselves",
    )
    api_names: list[str] = Field(
        default=[],
        description="names and addresses for the certificate; other names are refused, addresses are not",
    )
    api_notice: str = Field(
        default="", max_length=4000, description="what the console shows before it asks for a token"
    )
    api_lock_seconds: Seconds = Field(
        default=900,
        description="without use, after which the console forgets the token and asks for it again",
    )
    hosts: Path = Field(
        default=Path("ipsec/hosts.yaml"),
        description="the hosts that are meant to be enrolled; may be missing",
    )
    relays: Count = Field(
        default_factory=relays_for_this_machine,
        le=16,
        description="relay processes that share topics and monitors; by default one for every two cores, at most 4",
    )
    advertise: list[Advertisement] = []
    limits: Limits = Limits()
    audit: Audit = Audit()
    liveness: Liveness = Liveness()
    relay: Relay = Relay()
    recorder: RecorderRules = RecorderRules()
    firewall: Firewall = Firewall()
    ipsec: Ipsec = Ipsec()
    api_limits: ApiLimits = ApiLimits()

    @field_validator("api_tls")
    @classmethod
    def _clear_text_stays_here(cls, tls: bool, info: ValidationInfo) -> bool:
        api = info.data.get("api", "off")
        if not tls and api != "off" and not is_loopback(split_address(api)[0]):
            raise ValueError(
                f"tokens would cross the network in clear text: off is for a loopback address, and api is {api}"
            )
        return tls

    @field_validator("mediation")
    @classmethod
    def _mediation_fits(cls, mediation: str, info: ValidationInfo) -> str:
        if mediation == "monitored" and info.data.get("relaying") == "all":
            raise ValueError("monitored needs relaying: monitored (--relay monitored)")
        return mediation

    @model_validator(mode="after")
    def _receiver_is_reachable(self) -> Self:
        to = self.audit.syslog.to
        if to is not None and self.isolation == "netns" and is_loopback(split_receiver(to)[1]):
            raise ValueError(
                f"audit.syslog.to: {to} is the loopback of the appliance's own namespace (isolation: netns);"
                " a receiver on this machine is reached by another of its addresses"
            )
        return self

    @property
    def listen_address(self) -> tuple[str, int]:
        """`listen` as host and port."""
        return split_address(self.listen)

    @property
    def api_address(self) -> tuple[str, int] | None:
        """`api` as host and port; None when it is off."""
        return None if self.api == "off" else split_address(self.api)

    @property
    def own_services(self) -> list[str]:
        """What the appliance itself offers to nodes: the service that has the flight recorder record."""
        offered = self.recorder.enabled and "service" in self.recorder.triggers
        return [f"{self.publish_as}/record_now"] if offered else []


def load_resolved(path: Path) -> Settings:
    """What the supervisor wrote for its children. Raises `OSError`, `pydantic.ValidationError`."""
    return Settings.model_validate_json(path.read_bytes())
