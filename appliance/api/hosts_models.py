"""What `/v1/hosts` and `/v1/enrol` take and give."""

from typing import Annotated, Literal

from pydantic import ConfigDict, Field

from appliance.api.policy_models import Model

HOST_NAME = r"^[A-Za-z0-9](?:[A-Za-z0-9._-]{0,61}[A-Za-z0-9])?$"
ENDPOINT = r"^[A-Za-z0-9][A-Za-z0-9.:-]{0,252}$"
PORTS = r"^[0-9]{1,5}(?:-[0-9]{1,5})?$"
SERVICE = r"^(?:tcp|udp)/[0-9]{1,5}(?:-[0-9]{1,5})?$"
TOKEN = r"^rosrv-enrol_[0-9a-f]{12}_[A-Za-z0-9_-]{43}$"  # noqa: S105  the form of one
LONGEST_REQUEST = 16 << 10
LONGEST_DAYS = 398
LONGEST_TOKEN_SECONDS = 7 * 86_400

Name = Annotated[str, Field(pattern=HOST_NAME, description="`host:NAME` in the policy")]
Days = Annotated[
    float, Field(gt=0, le=LONGEST_DAYS, allow_inf_nan=False, description="until the certificate ends")
]
SigningRequest = Annotated[
    str, Field(min_length=1, max_length=LONGEST_REQUEST, description="PKCS #10, in PEM")
]
State = Literal["up", "down", "expired", "revoked", "not wanted", "awaited", "not enrolled"]
PortsState = Literal["closed", "open", "unknown"]


class Asked(Model):
    """What is taken is exact: `true` is no number, and a text of digits is none either."""

    model_config = ConfigDict(strict=True)


class PortsSeen(Model):
    """Whether a machine's ROS ports are closed to all but the appliance, as somebody saw who tried from outside."""

    state: PortsState
    checked: float | None = Field(description="seconds since the epoch; null: never")
    open: list[int] = Field(description="TCP ports that accepted a connection, the first hundred")
    who: str = Field(description="the token by which it was told, or `operator`; empty: never tried")


class Host(Model):
    """A host that comes through a tunnel; times are seconds since the epoch.

    `awaited`: it has a token and has not enrolled yet. `not wanted`: hosts.yaml says that its tunnel stays closed.
    """

    name: str
    address: str | None = Field(description="its virtual address, which it keeps for good")
    state: State
    groups: list[str] = Field(description="of hosts.yaml")
    declared: bool = Field(description="it is in hosts.yaml")
    wanted: bool = Field(description="hosts.yaml wants its tunnel, or does not know it")
    divergence: str | None = Field(description="what is different from hosts.yaml, in a sentence")
    serial: str | None = Field(description="of its certificate, in hexadecimal")
    enrolled: float | None
    expires: float | None = Field(description="the end of its certificate")
    expires_soon: bool = Field(description="within 14 days, or a third of its life if that is shorter")
    renewing: bool = Field(description="it has a newer certificate that it has not put in place yet")
    revoked: float | None
    remote: str | None = Field(description="where it really is; null: no tunnel")
    seconds: int | None = Field(description="age of the SA")
    bytes_in: int | None
    bytes_out: int | None
    last_seen: float | None = Field(description="when something last came through its tunnel")
    token_expires: float | None = Field(description="until when its one-time token can be used; null: none")
    ports: PortsSeen


class Machine(Model):
    """A machine in clear text on which nodes run, by its address."""

    address: str
    nodes: int
    ports: PortsSeen


class Hosts(Model):
    """All hosts, and how the tunnels stand."""

    revision: int = Field(description="the number in the ETag")
    hosts: list[Host]
    machines: list[Machine] = Field(description="machines of nodes without a tunnel")
    esp: Literal["kernel", "user space"] | None = Field(
        description="where ESP runs; null: no tunnels are open"
    )
    key_exchange: list[str] = Field(description="offered and accepted, the best first; empty: not known yet")
    post_quantum: bool | None = Field(description="whether ML-KEM is among them; null: not known yet")
    pool: str
    address: str = Field(description="the appliance's own in the tunnels")
    hosts_file: str
    troubles: list[str] = Field(description="what a person should look at")


class KitWishes(Asked):
    """What goes into a kit besides the certificate."""

    endpoint: Annotated[str, Field(pattern=ENDPOINT)] | None = Field(
        default=None,
        description="address or name at which the host reaches the appliance; null: `ipsec.endpoint` of the"
        " configuration, else the machine's address towards its default route (422 when that cannot be told)",
    )
    ports: Annotated[
        str, Field(pattern=PORTS, description="the host's local port range, which its firewall closes")
    ] = "32768-60999"
    open: list[Annotated[str, Field(pattern=SERVICE)]] = Field(
        default=[], max_length=100, description="services of the host that stay open, such as tcp/22"
    )


class NewHost(KitWishes):
    """A host to enrol."""

    name: Name
    how: Literal["token", "kit"] = Field(
        default="token",
        description="token: the host makes its own key and brings a one-time token (POST /v1/enrol); kit: an"
        " archive with a private key in it, to be carried there",
    )
    address: str | None = Field(
        default=None, max_length=64, description="its virtual address; null: the next free one"
    )
    days: Days = 90
    token_seconds: Annotated[float, Field(ge=60, le=LONGEST_TOKEN_SECONDS, allow_inf_nan=False)] = 3600
    request: SigningRequest | None = Field(
        default=None, description="with how=kit: of a key that the host has; the kit has no private key then"
    )


class TokenWishes(KitWishes):
    """A one-time token for a host, new or enrolled before."""

    address: str | None = Field(default=None, max_length=64)
    days: Days = 90
    token_seconds: Annotated[float, Field(ge=60, le=LONGEST_TOKEN_SECONDS, allow_inf_nan=False)] = 3600


class NewKit(KitWishes):
    """A new certificate for an enrolled host, in a kit; the one before is revoked."""

    days: Days = 90
    request: SigningRequest | None = None


class EnrolmentToken(Model):
    """A one-time token: shown this once."""

    name: str
    address: str = Field(description="the virtual address that is kept for it")
    token: str
    expires: float
    endpoint: str = Field(description="address or name at which the host reaches the appliance")
    endpoint_reason: str = Field(description="why this one, where none was given; else empty")
    url: str = Field(description="where the host brings it: POST /v1/enrol there")
    pin: str = Field(description="of the key of that server, as curl's --pinnedpubkey takes it")
    authority: str = Field(description="SHA-256 of the authority's certificate, in hexadecimal")
    script: str = Field(
        description="join.sh: makes the key on the host, enrols it, starts and checks the tunnel"
    )


class Enrolment(Asked):
    """What a host brings to be enrolled."""

    token: Annotated[str, Field(pattern=TOKEN)]
    request: SigningRequest


class Enrolled(Model):
    """A host is enrolled; `files` are those of its kit, by path, all but the private key."""

    name: str
    address: str
    appliance: str = Field(description="the appliance's address in the tunnel")
    master: str = Field(description="ROS_MASTER_URI through the tunnel")
    serial: str
    expires: float
    certificate: str
    authority: str
    warning: str | None
    files: dict[str, str]


class Renewal(Asked):
    """A signing request for a new key, and the present key's signature over its bytes (base64)."""

    request: SigningRequest
    proof: Annotated[str, Field(min_length=1, max_length=1024, pattern=r"^[A-Za-z0-9+/]+={0,2}$")]


class NewCertificate(Model):
    """The certificate for the new key; the one before is good until `renewed` is called."""

    name: str
    serial: str
    expires: float
    certificate: str
    authority: str


class Revoked(Model):
    """A host was let out for good."""

    name: str
    address: str
    serial: str
    taken_back: int = Field(description="registrations and grants")


class PortsTold(Asked):
    """What `rosrv protect --check` saw."""

    state: PortsState
    open: list[Annotated[int, Field(ge=1, le=65_535)]] = Field(default=[], max_length=100)
    checked: Annotated[float, Field(ge=0, le=4_000_000_000, allow_inf_nan=False)] | None = Field(
        default=None, description="null: now"
    )


class Reloaded(Model):
    """hosts.yaml was read again."""

    revision: int
    declared: list[str]
    opened: list[str] = Field(description="hosts whose tunnel is wanted again")
    closed: list[str] = Field(description="hosts whose tunnel is no longer wanted")
    divergence: list[str]
