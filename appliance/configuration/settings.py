"""Define every setting with its default, as in `appliance.yaml`.

The supervisor writes the result to `run/config.json` in the state directory for the other processes.
"""

import dataclasses
import hashlib
import ipaddress
import os
import re
from collections.abc import Callable
from ipaddress import IPv4Network
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    GetPydanticSchema,
    IPvAnyAddress,
    IPvAnyNetwork,
    ValidationInfo,
)

from appliance.configuration.quantities import (
    Count,
    Milliseconds,
    Seconds,
    Size,
    SizeOfMebibytes,
)
from appliance.configuration.sections import (
    HOST_NAME,
    S,
    Sections,
    T,
    is_loopback,
    key,
    section,
    split_address,
)
from appliance.features.table import FEATURES
from appliance.signing.site_keys import checked_key

_NODE_NAME = re.compile(r"(/[A-Za-z][A-Za-z0-9_]{0,99}+){1,5}")

SECTIONS = tuple(feature.settings for feature in FEATURES if feature.settings is not None)


def with_features(place: str) -> Callable[[type[T]], type[T]]:
    def extend(cls: type[T]) -> type[T]:
        for kind in SECTIONS:
            above, _, name = kind.place.rpartition(".")
            if above == place:
                cls.__annotations__[name] = kind
                setattr(cls, name, kind())
        return cls

    return extend


_NETWORK = GetPydanticSchema(lambda _source, handler: handler(IPvAnyNetwork))
_ADDRESS = GetPydanticSchema(lambda _source, handler: handler(IPvAnyAddress))


def _comma_separated(value: object) -> object:
    return (
        ",".join(value) if isinstance(value, list) and all(isinstance(item, str) for item in value) else value
    )


def _all_or_names(value: str) -> str:
    """Raise `ValueError` for `all`, `none` or `shadow` beside names."""
    names = [name.strip() for name in value.split(",")]
    words = sorted({"all", "none", "shadow"}.intersection(names))
    if words and len(names) > 1:
        raise ValueError(f"{words[0]} applies to all monitors, so it cannot be combined with names: give one")
    return value


class Unasked(str):
    """A default string. Its class distinguishes it from a string that the user configured."""

    __slots__ = ()


def _check_address(text: str) -> str:
    split_address(text)
    return text


def _check_endpoint(text: str | None) -> str | None:
    if text is None:
        return None
    example = "for example 192.168.1.20 or robot.example.org"
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        if HOST_NAME.fullmatch(text) is None or text.replace(".", "").isdecimal():
            raise ValueError(
                f"{text!r} is neither an address nor a name (no port, no brackets), {example}"
            ) from None
        if is_loopback(text):
            raise ValueError(f"{text} means this machine only: no other host reaches it, {example}") from None
        return text
    if address.is_loopback or address.is_unspecified or address.is_multicast or address.is_link_local:
        raise ValueError(f"{text} is not an address at which other hosts reach the appliance, {example}")
    return str(address)


def _none_if_empty(value: object) -> object:
    return None if value == "" else value  # compose passes an unset variable as ""


def _check_topic(text: str) -> str:
    if text and _NODE_NAME.fullmatch(text) is None:
        raise ValueError(f"{text!r} is not a global topic name, for example /rosrv/heartbeat")
    return text


def _check_name(text: str) -> str:
    if _NODE_NAME.fullmatch(text) is None:
        raise ValueError(f"{text!r} is not a global node name, for example /rosrv")
    return text


def _off_as_text(value: object) -> object:
    return "off" if value is False else value  # YAML reads a bare `off` as false


def _check_api(text: str) -> str:
    return text if text == "off" else _check_address(text)


@section
class Advertisement:
    """The appliance's address for nodes of one network."""

    network: Annotated[str, _NETWORK, AfterValidator(str)]
    address: Annotated[str, _ADDRESS, AfterValidator(str)]


@section
class LimitsSection:
    """Limits of RVMaster and the proxy endpoints; the defaults exceed the needs of a large robot."""

    body_bytes: Size = key(default=16 << 20, description="body of a request")
    elements: Count = key(default=1_000_000, description="values in one request")
    nesting: Count = key(default=100, description="arrays and structs inside each other")
    string_bytes: Size = key(default=8 << 20, description="one string")
    multicall_parts: Count = key(default=100_000, description="calls in one system.multicall")
    parameter_bytes: Size = key(
        default=64 << 20,
        description="all parameters together, as they are sent; one host may set half of them",
    )
    header_bytes: Size = key(default=64 << 10, description="request line and headers")
    header_seconds: Seconds = key(
        default=10.0, description="until request line and headers must have arrived"
    )
    idle_seconds: Seconds = key(default=300.0, description="a kept-alive connection without a request")
    connections_per_host: Count = key(default=512, description="open connections of one host")
    connections: Count = key(default=4096, description="of all hosts")
    nodes_per_host: Count = key(default=500, description="registered nodes of one host")
    topics_per_host: Count = key(
        default=12_500, description="registrations of one host: topics, services and parameters"
    )
    node_call_seconds: Seconds = key(default=3.0, description="a call that the appliance makes to a node")
    offload_bytes: Size = key(
        default=256 << 10, description="larger bodies are parsed outside the event loop"
    )


@section
@with_features("audit")
class Audit:
    """The audit log."""

    durability: Literal["strict", "batched"] = key(
        default="batched", description="strict: on disk before the answer; batched: within 50 ms"
    )
    on_audit_failure: Literal["deny", "allow"] = key(
        default="deny", description="answer to requests while the log cannot be written"
    )
    checkpoint_records: Count = key(default=1000, description="records after which a checkpoint is signed")
    checkpoint_seconds: Seconds = key(default=60.0, description="seconds after which a checkpoint is signed")
    retention_days: Seconds | None = key(
        default=None, description="older records are removed, and that is recorded"
    )
    retention_bytes: SizeOfMebibytes | None = key(
        default=None, description="beyond this size the oldest records are removed"
    )
    reserve_bytes: SizeOfMebibytes = key(
        default=64 << 20,
        description="of free disk space: below it, hosts that cause many records are slowed more, so that others"
        " are recorded",
    )


@section
class LivenessSection:
    """When a node counts as gone; all in seconds."""

    interval: Seconds = key(default=5.0, description="between two checks of a node")
    silent: Seconds = key(default=20.0, description="without an answer until the node is unregistered")
    shadow: Seconds = key(
        default=600.0,
        description="for which the registration of a node that is gone can be restored; for at least a day if the node"
        " may still run, because it is only out of reach",
    )


@section
class Relay:
    """The limits of the relay."""

    connections: Count = key(default=16_384, description="of all hosts")
    connections_per_host: Count = key(default=8_192, description="connections of one host")
    header_bytes: Size = key(default=64 << 10, description="TCPROS connection header")
    header_seconds: Seconds = key(default=10.0, description="until the connection header must have arrived")
    message_bytes: SizeOfMebibytes = key(default=256 << 20, description="one message")
    queue_messages: Count = key(default=1000, description="messages waiting for one subscriber")
    queue_bytes: Size = key(default=64 << 20, description="bytes waiting for one subscriber")
    memory_bytes: Size = key(
        default=1 << 30,
        description="of one relay: half for unfinished messages, a quarter each for queues and latched ones",
    )
    budget: Milliseconds = key(
        default=10.0,
        description="milliseconds of processor time that monitors may take for one message; more is a fault",
    )
    late: Annotated[float, Field(ge=1.0, le=100.0, allow_inf_nan=False)] = key(
        default=20.0,
        description="milliseconds after which a tick of a guard, or a message that it judged, is late: an alarm",
    )
    heartbeat: Annotated[str, AfterValidator(_check_topic)] = key(
        default="",
        description="topic (std_msgs/Bool) of the heartbeat, a square wave of 10 Hz while every guard can act",
    )
    heartbeat_line: str = key(
        default="",
        pattern=r"^(/dev/[A-Za-z0-9_./-]{1,200})?$",
        description="serial line of the heartbeat, such as /dev/ttyUSB0: 9600 baud, 0x55 and 0xAA in turn",
    )


@section
class FirewallSection:
    """The firewall around the ROS master (isolation netns and container)."""

    backend: Literal["auto", "iptables", "nft"] = key(
        default="auto", description="auto: the back end that the kernel enforces"
    )
    hold: Annotated[Literal["others", "own", "off"], BeforeValidator(_off_as_text)] = key(
        default="others",
        description="until the service serves, new connections to ROS ports wait: of other machines, also the robot's"
        " own to its master, or none",
    )
    hold_seconds: Annotated[int, Field(ge=1, le=3600)] = key(
        default=60,
        description="with `hold: own`, after which the robot's own programs start without the appliance",
    )


def _is_ipv4(pool: object) -> object:
    if isinstance(pool, str) and ":" in pool:
        raise ValueError(
            f"{pool}: virtual addresses are IPv4, which every ROS 1 node speaks; take a private /24"
        )
    return pool


def _has_room_for_hosts(pool: IPv4Network) -> IPv4Network:
    if not 16 <= pool.prefixlen <= 29:
        raise ValueError(f"{pool} must have a prefix length from 16 to 29")
    return pool


@section
class Ipsec:
    """The tunnels of trusted hosts; they are opened when the first host is enrolled."""

    pool: Annotated[
        IPv4Network,
        BeforeValidator(_is_ipv4),
        AfterValidator(_has_room_for_hosts),
    ] = key(
        default=IPv4Network("10.113.11.0/24"),
        description="virtual addresses of the hosts in tunnels; the first one is the appliance's",
    )

    endpoint: Annotated[
        str | None,
        BeforeValidator(_none_if_empty),
        AfterValidator(_check_endpoint),
    ] = key(
        default=None,
        description="address or name at which hosts reach the appliance from outside, for their kits;"
        " detected unless given here or with --appliance",
    )

    ca: Literal["ecdsa", "ed25519"] = key(
        default="ecdsa",
        description="kind of the authority's key, created at the first start: P-384, or Ed25519",
    )
    ca_passphrase_file: Path | None = key(
        default=None,
        description="file, readable by root only, whose first line encrypts the authority's key;"
        " also ROSRV_CA_PASSPHRASE_FILE",
    )


@section
class ApiLimits:
    """Limits of the REST interface. Beyond them, a client gets 429 or 503 with the seconds to wait."""

    body_bytes: Size = key(default=1 << 20, description="body of a request")
    requests_per_second: Seconds = key(default=50.0, description="of one host, on average")
    burst: Count = key(default=200, description="requests of one host at once")
    failures_per_minute: Count = key(default=20, description="requests of one host without a good token")
    connections: Count = key(default=512, description="of all hosts")
    connections_per_host: Count = key(default=320, description="connections of one host")
    header_seconds: Seconds = key(default=10.0, description="until the request's headers must have arrived")
    streams: Count = key(default=64, description="clients that follow the audit log, at once")


def relays_for_this_machine() -> int:
    return max(1, min(4, (os.cpu_count() or 1) // 2))


def _clear_text_stays_here(tls: bool, info: ValidationInfo) -> bool:
    api = info.data.get("api", "off")
    if not tls and api != "off" and not is_loopback(split_address(api)[0]):
        raise ValueError(
            f"tokens would cross the network in clear text: off is for a loopback address, and api is {api}"
        )
    return tls


def _mediation_fits(mediation: str, info: ValidationInfo) -> str:
    if mediation == "monitored" and info.data.get("relaying") == "all":
        raise ValueError("monitored needs relaying: monitored (--relay monitored)")
    return mediation


@section
@with_features("")
class Settings:
    """All settings."""

    name: str = key(
        default="",
        pattern=r"^([A-Za-z0-9][A-Za-z0-9.-]{0,62})?$",
        description="the robot's name: in the console, the status, the metrics, the names of exported files, and REST's"
        " certificate; also the sender in syslog",
    )
    policy: Path = key(
        default=Path("policies/default.ini"), description="the access policy; read again on reload"
    )
    monitors: Path | None = key(
        default=None, description="folder of specifications (.rv) of monitors; read again on reload"
    )
    enable: Annotated[str, BeforeValidator(_comma_separated), AfterValidator(_all_or_names)] = key(
        default="all",
        description="initial state of monitors that no operator has switched, including new ones: all enabled, none,"
        " NAME,… or a list of names, or all in shadow mode (shadow)",
    )
    forgotten_after: Seconds | None = key(
        default=86_400.0,
        description="seconds for which a monitor may be disabled or in shadow mode, or a section of the policy"
        " audit-only, before that is an alarm; with null, it never is",
    )
    on_fault: Literal["drop", "pass"] = key(
        default="drop", description="handling of a message at which an action of a monitor faults"
    )
    slices: int = key(
        default=100_000,
        ge=1,
        le=1_000_000,
        description="slices of a parametric specification: bindings monitored at the same time, about 700 bytes each",
    )
    publish_as: Annotated[str, AfterValidator(_check_name)] = key(
        default="/rosrv", description="the node name under which monitors publish"
    )
    monitors_on_rosout: bool = key(
        default=False,
        description="also put output, verdicts and faults of monitors on /rosout (the audit log always has them)",
    )
    alarms_on_diagnostics: bool = key(
        default=False,
        description="also publish the alarms and the guards' states on /diagnostics (diagnostic_msgs/DiagnosticArray)",
    )
    hide_publisher: bool = key(default=False, description="omit the monitors' topics from getSystemState")
    site_keys: list[Annotated[str, AfterValidator(checked_key)]] = key(
        default=[],
        description="public keys (`ssh-ed25519 BASE64 COMMENT`); with any, a policy or specification that none of them"
        " signed is rejected",
    )
    state: Path = key(
        default=Path("/var/lib/rosrv"),
        description="directory of all data that must survive a restart; only `up` and `selftest` read this key, others"
        " use --state or ROSRV_STATE",
    )
    listen: Annotated[str, AfterValidator(_check_address)] = key(
        default="0.0.0.0:11311", description="address where nodes find their master"
    )
    rosmaster_port: int = key(
        # 11411 is rosserial's TCP port; the kernel's ephemeral ports start above this one.
        default=12311,
        ge=0,
        le=65_535,
        description="loopback port of the ROS master; with 0, any free one",
    )
    isolation: Literal["container", "netns", "none"] = key(
        default="netns",
        description="isolation of the appliance; with none, it has no firewall: for development only",
    )
    relaying: Literal["all", "monitored"] = key(
        default="all",
        description="topics and services that go through the relay; `monitored` (those that a specification, [Monitor],"
        " [Limits], [Authority] or `ask` names) is not a boundary",
    )
    mediation: Annotated[Literal["full", "monitored"], AfterValidator(_mediation_fits)] = key(
        default="full",
        description="`monitored` tells nodes each other's real URIs; needs relaying: monitored",
    )
    api: Annotated[str, BeforeValidator(_off_as_text), AfterValidator(_check_api)] = key(
        default_factory=lambda: Unasked("127.0.0.1:8443"),
        json_schema_extra={"default": "127.0.0.1:8443"},
        description="HOST:PORT of REST, or off; by default, another free port if this one is in use",
    )
    api_tls: Annotated[bool, AfterValidator(_clear_text_stays_here)] = key(
        default=True, description="false: clear text, on a loopback address only"
    )
    api_require_proof: bool = key(
        default=False,
        description="true: changes over REST need signed requests (docs/reference/rest.md), not only a bare token",
    )
    api_networks: list[Annotated[str, _NETWORK, AfterValidator(str)]] = key(
        default=[], description="who may connect to REST besides this machine (the firewall's rule)"
    )
    api_published: bool = key(
        default=True,
        description="off: other machines cannot reach the port although it listens (a container that publishes it on"
        " loopback), so that hosts cannot enrol themselves",
    )
    api_names: list[str] = key(
        default=[],
        description="names and addresses for the certificate; requests to other names are rejected, to addresses not",
    )
    api_notice: str = key(
        default="", max_length=4000, description="notice that the console shows before it asks for a token"
    )
    api_lock_seconds: Seconds = key(
        default=900.0,
        description="without use, after which the console forgets the token and asks for it again",
    )
    hosts: Path = key(
        default=Path("ipsec/hosts.yaml"),
        description="the hosts to enrol; the file may be missing",
    )
    relays: Annotated[int, Field(gt=0, le=16)] = key(
        default_factory=relays_for_this_machine,
        description="relay processes that share topics and monitors; by default one for every two cores, at most 4",
    )
    advertise: list[Advertisement] = key(
        default=[],
        description="the appliance's address for nodes of each network; by default the address that reaches the node",
    )
    limits: LimitsSection = LimitsSection()
    audit: Audit = Audit()
    liveness: LivenessSection = LivenessSection()
    relay: Relay = Relay()
    firewall: FirewallSection = FirewallSection()
    ipsec: Ipsec = Ipsec()
    api_limits: ApiLimits = ApiLimits()

    @property
    def rest_names(self) -> list[str]:
        return [*self.api_names, *filter(None, [self.name])]

    def __post_init__(self) -> None:
        for kind in SECTIONS:
            section = self.of(kind)
            for name, (url, address) in section.receivers().items():
                if address and self.isolation == "netns" and is_loopback(address):
                    raise ValueError(
                        f"{kind.place}.{name}: {url} is the loopback of the appliance's own namespace"
                        " (isolation: netns); for a receiver on this machine, use another of its addresses"
                    )
            if section.holds_records and self.audit.retention_days is None:
                raise ValueError(
                    f"{kind.place}.{section.holds_records} has no effect without audit.retention_days"
                )

    def of(self, kind: type[S]) -> S:
        value: object = self
        for name in kind.place.split("."):
            value = getattr(value, name)
        assert isinstance(value, kind)  # noqa: S101  `with_features` has added it
        return value

    @property
    def sections(self) -> Sections:
        return Sections({kind: self.of(kind) for kind in SECTIONS})

    def fingerprints(self) -> dict[str, str]:
        """Return the start of the SHA-256 of each setting, so that records show which of them changed, not to what."""
        values = dataclasses.asdict(self).items()
        return {name: hashlib.sha256(repr(value).encode()).hexdigest()[:16] for name, value in values}

    def audit_values(self) -> dict[str, dict[str, str]]:
        """Return the values that sections admit to the audit log, by section and name."""
        found = {kind.place: self.of(kind).audit_values() for kind in SECTIONS}
        return {place: values for place, values in found.items() if values}

    @property
    def listen_address(self) -> tuple[str, int]:
        return split_address(self.listen)

    @property
    def api_address(self) -> tuple[str, int] | None:
        return None if self.api == "off" else split_address(self.api)

    @property
    def own_services(self) -> list[str]:
        return [f"{self.publish_as}/{name}" for kind in SECTIONS for name in self.of(kind).services()]


def load_resolved(path: Path) -> Settings:
    """Read the settings that the supervisor wrote. Raises `OSError`, `msgspec.ValidationError`."""
    return msgspec.json.decode(path.read_bytes(), type=Settings, dec_hook=lambda kind, text: kind(text))
