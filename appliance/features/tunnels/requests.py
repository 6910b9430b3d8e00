"""Define the requests about hosts in tunnels, for the admin socket and REST."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.admin import AdminRequest, WaitingRequest
from appliance.channel.answers.field_docs import doc
from appliance.channel.answers.host_answers import PortsState
from appliance.channel.rest_bodies import DATED, WHOLE
from appliance.channel.rest_operation import Body, Versioned, parameter, rest
from appliance.features.tunnels import tunnel_answers

# Define the bodies of REST requests about hosts in tunnels. An unknown field is an error.

HOST_NAME = r"^[A-Za-z0-9](?:[A-Za-z0-9._-]{0,61}[A-Za-z0-9])?$"
ENDPOINT = r"^[A-Za-z0-9][A-Za-z0-9.:-]{0,252}$"
PORTS = r"^[0-9]{1,5}(?:-[0-9]{1,5})?$"
SERVICE = r"^(?:tcp|udp)/[0-9]{1,5}(?:-[0-9]{1,5})?$"
LONGEST_REQUEST = 16 << 10
LONGEST_DAYS = 398
LONGEST_TOKEN_SECONDS = 7 * 86_400
HostName = Annotated[str, doc("name of the host, `host:NAME` in the policy", pattern=HOST_NAME + WHOLE)]
Endpoint = Annotated[str, msgspec.Meta(pattern=ENDPOINT + WHOLE)]
GivenEndpoint = Annotated[
    Endpoint | None,
    doc(
        "address or name at which the host reaches the appliance; by default, `ipsec.endpoint` of the"
        " configuration, else the machine's address towards its default route (422 if it has none)"
    ),
]
Ports = Annotated[str, doc("the host's local port range, which its firewall closes", pattern=PORTS + WHOLE)]
Service = Annotated[str, msgspec.Meta(pattern=SERVICE + WHOLE)]
GivenAddress = Annotated[
    Annotated[str, msgspec.Meta(max_length=64)] | None,
    doc("its virtual address; by default, the next free one"),
]
Port = Annotated[int, msgspec.Meta(ge=1, le=65_535)]
Days = Annotated[float, doc("until the certificate ends", gt=0, le=LONGEST_DAYS)]
TokenSeconds = Annotated[
    float, doc("seconds for which the one-time token is valid", ge=60, le=LONGEST_TOKEN_SECONDS)
]
FilledRequest = Annotated[str, msgspec.Meta(max_length=LONGEST_REQUEST)]  # empty until the api fills it in
SigningRequest = Annotated[str, doc("PKCS #10, in PEM", min_length=1, max_length=LONGEST_REQUEST)]
Open = Annotated[list[Service], doc("the host's services that stay open, such as tcp/22", max_length=100)]


class KitWishes(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The contents of a kit besides the certificate."""

    endpoint: GivenEndpoint = None
    ports: Ports = "32768-60999"
    open: Open = msgspec.field(default_factory=list)


class TokenWishes(KitWishes, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A one-time token for a host, new or enrolled before."""

    address: GivenAddress = None
    days: Days = 90
    token_seconds: TokenSeconds = 3600


class NewHost(TokenWishes, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A host to enrol."""

    name: HostName
    how: Annotated[
        Literal["token", "kit"],
        doc(
            "token: the host makes its own key and presents a one-time token (POST /v1/enrol); kit: an archive with a"
            " private key in it, to be copied to the host"
        ),
    ] = "token"
    request: Annotated[
        SigningRequest | None,
        doc("with how=kit: signing request for the host's own key; the kit then has no private key"),
    ] = None


class NewKit(KitWishes, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A new certificate for an enrolled host, in a kit; the earlier one is revoked."""

    days: Days = 90
    request: SigningRequest | None = None


HOSTS = Versioned("table of hosts", "/v1/hosts", "The table of hosts is not the one that If-Match names.")
_NO_HOST = {404: "There is no such host."}
_KIT = (
    "a kit is made on the appliance's machine, without --api; over REST take --token, with which no private key"
    " travels"
)
_CHARON_SECONDS = 45.0  # charon may have to be started first
OneHost = Annotated[
    str,
    parameter("name of the host", min_length=1, max_length=63, pattern=HOST_NAME + WHOLE, examples=["ocu-1"]),
]


@rest(
    "admin", "POST", "/v1/hosts", name="enrol_host", words="Enrol a host: by a one-time token that it presents with"
    " its own signing request, or by a kit.", body=NewHost, says={"how": "token"}, fixed={"new": True},
    of=HOSTS, status=201, good="Enrolled: the kit (how=kit); or a one-time token (how=token)",
    seconds=_CHARON_SECONDS,
)  # fmt: skip
@rest(
    "admin", "POST", "/v1/hosts/{name}/token", name="host_token", body=TokenWishes, fixed={"new": False},
    of=HOSTS, seconds=_CHARON_SECONDS,
)  # fmt: skip
class HostToken(WaitingRequest[tunnel_answers.EnrolmentToken], frozen=True, tag="host token"):
    """A one-time token: with it the host enrols itself, for the first time or again with another key."""

    name: OneHost
    # These three are kept with the token, to make the host's kit later; endpoint None: the appliance finds it.
    endpoint: GivenEndpoint = None
    ports: Ports = "32768-60999"
    open: Open = msgspec.field(default_factory=list)
    token_seconds: TokenSeconds = 3600
    days: Days = 90
    address: GivenAddress = None
    expected: int | None = None
    new: bool = False  # rejected for a host that is enrolled; else such a host may come with another key


@rest(
    "admin", "POST", "/v1/hosts", says={"how": "kit"}, of=HOSTS, seconds=_CHARON_SECONDS, filled=("request",),
    machine_only=_KIT,
)  # fmt: skip
class HostAdd(WaitingRequest[tunnel_answers.KitParts], frozen=True, tag="host add"):
    """Enrol a host by a signing request (PKCS #10, PEM) for its own key, for `days`.

    `address` is its virtual address; None: the next free one.
    """

    name: HostName
    request: FilledRequest
    days: Days = 90
    address: GivenAddress = None
    expected: int | None = None


@rest(None, seconds=_CHARON_SECONDS, changes=True)
class HostEnrol(WaitingRequest[tunnel_answers.KitParts], frozen=True, tag="host enrol"):
    """A host at the real address `peer` enrols itself with its token and a signing request (PEM)."""

    token: str
    request: str
    peer: str


@rest(
    "admin", "POST", "/v1/hosts/{name}/kit", name="new_host_kit", body=NewKit, of=HOSTS, problems=_NO_HOST,
    seconds=_CHARON_SECONDS, filled=("request",), good="The kit: an archive (.tar.gz)", machine_only=_KIT,
)  # fmt: skip
class HostRenew(WaitingRequest[tunnel_answers.KitParts], frozen=True, tag="host renew"):
    """A new certificate for an enrolled host, in a kit; the earlier one is revoked and its tunnel closed."""

    name: OneHost
    request: FilledRequest
    days: Days = 90
    expected: int | None = None


@rest(None, seconds=_CHARON_SECONDS, changes=True)
class HostRenewItself(WaitingRequest[tunnel_answers.NewCertificate], frozen=True, tag="host renew itself"):
    """A host asks through its tunnel, at its virtual address `peer`, for a certificate for a new key.

    `proof` is the signature of its present key over the bytes of `request`. The earlier certificate is valid
    until `HostRenewed`.
    """

    name: str
    request: str
    proof: bytes
    peer: str


@rest(None, seconds=_CHARON_SECONDS, changes=True)
class HostRenewed(AdminRequest[tunnel_answers.Renewed], frozen=True, tag="host renewed"):
    """A host at its virtual address `peer` has installed its new certificate, so the earlier one ends now."""

    name: str
    peer: str


@rest("viewer", "GET", "/v1/hosts", name="hosts", of=HOSTS)
class HostList(AdminRequest[tunnel_answers.Hosts], frozen=True, tag="host list"):
    """Every host that is enrolled, declared or awaited, with its tunnel, and the machines with nodes."""


@rest("viewer", machine_only=_KIT)
class HostEndpoint(WaitingRequest[tunnel_answers.Endpoint], frozen=True, tag="host endpoint"):
    """The address at which hosts reach the appliance unless one is given: `endpoint`, with the `reason`."""


@rest("operator")
class HostKit(WaitingRequest[tunnel_answers.KitParts], frozen=True, tag="host kit"):
    """The parts of an enrolled host's kit, without its private key."""

    name: str


@rest("admin", "DELETE", "/v1/hosts/{name}", name="revoke_host", of=HOSTS, problems=_NO_HOST)
class HostRevoke(AdminRequest[tunnel_answers.Revoked], frozen=True, tag="host revoke"):
    """Exclude a host: its certificate, tunnel, registrations and connections end within a second."""

    name: OneHost
    expected: int | None = None


@rest(
    "operator", "PUT", "/v1/hosts/{name}/ports", name="tell_host_ports", of=HOSTS,
    body=Body("PortsTold", "The findings of `rosrv protect --check`."), problems=_NO_HOST, answer_field="ports",
)  # fmt: skip
class HostPorts(AdminRequest[tunnel_answers.PortsReport], frozen=True, tag="host ports"):
    """Report whether the ROS ports of a host are closed, as `rosrv protect --check` found from outside."""

    name: Annotated[
        str,
        parameter(
            "name of the host, or a machine's address", min_length=1, max_length=63, examples=["ocu-1"]
        ),
    ]
    state: Annotated[PortsState, doc("its state")]
    open: Annotated[list[Port], doc("TCP ports that accepted a connection", max_length=100)] = msgspec.field(
        default_factory=list
    )
    checked: Annotated[
        Annotated[float, msgspec.Meta(ge=0, le=4_000_000_000)] | None,
        doc("RFC 3339, or seconds since the epoch; by default, now", extra={DATED: True}),
    ] = None
    expected: int | None = None


@rest("operator", "POST", "/v1/hosts/reload", name="reload_hosts", of=HOSTS)
class HostsReload(AdminRequest[tunnel_answers.Reloaded], frozen=True, tag="hosts reload"):
    """Read hosts.yaml again, and open and close tunnels accordingly. Enrolments and revocations do not change."""

    expected: int | None = None


@rest(None)
class RevocationsWanted(WaitingRequest[tunnel_answers.RevocationList], frozen=True, tag="host revocations"):
    """The authority's signed list of revoked certificates, in PEM."""


@rest(None)
class AuthorityWanted(WaitingRequest[tunnel_answers.AuthorityCertificate], frozen=True, tag="host authority"):
    """The authority's certificate, in PEM."""


REQUESTS: tuple[type[AdminRequest[object]], ...] = (
    HostToken,
    HostAdd,
    HostEnrol,
    HostRenew,
    HostRenewItself,
    HostRenewed,
    HostList,
    HostEndpoint,
    HostKit,
    HostRevoke,
    HostPorts,
    HostsReload,
    RevocationsWanted,
    AuthorityWanted,
)
