"""Define the requests about hosts in tunnels, for the admin socket and REST."""

from typing import Annotated, Literal

from appliance.channel.admin import AdminRequest, WaitingRequest
from appliance.channel.rest_operation import Versioned, parameter, rest
from appliance.features.tunnels import rest_bodies as bodies
from appliance.features.tunnels import tunnel_answers

HOSTS = Versioned("table of hosts", "/v1/hosts", "The table of hosts is not the one that If-Match names.")
_NO_HOST = {404: "There is no such host."}
_KIT = (
    "a kit is made on the appliance's machine, without --api; over REST take --token, with which no private key"
    " travels"
)
_CHARON_SECONDS = 45.0  # charon may have to be started first
OneHost = Annotated[
    str,
    parameter("name of the host", min_length=1, max_length=63, pattern=bodies.HOST_NAME, examples=["ocu-1"]),
]


@rest(
    "admin", "POST", "/v1/hosts", name="enrol_host", words="Enrol a host: by a one-time token that it presents with"
    " its own signing request, or by a kit.", body=bodies.NewHost, says={"how": "token"}, fixed={"new": True},
    of=HOSTS, status=201, good="Enrolled: the kit (how=kit); or a one-time token (how=token)",
    seconds=_CHARON_SECONDS,
)  # fmt: skip
@rest(
    "admin", "POST", "/v1/hosts/{name}/token", name="host_token", body=bodies.TokenWishes, fixed={"new": False},
    of=HOSTS, seconds=_CHARON_SECONDS,
)  # fmt: skip
class HostToken(WaitingRequest[tunnel_answers.EnrolmentToken], frozen=True, tag="host token"):
    """A one-time token: with it the host enrols itself, for the first time or again with another key."""

    name: OneHost
    # These three are kept with the token, to make the host's kit later; endpoint None: the appliance finds it.
    endpoint: str | None = None
    ports: str = "32768-60999"
    open: list[str] = []  # noqa: RUF012  each struct gets one of its own
    token_seconds: float = 3600
    days: float = 90
    address: str | None = None
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

    name: str
    request: str
    days: float = 90
    address: str | None = None
    expected: int | None = None


@rest(None, seconds=_CHARON_SECONDS, changes=True)
class HostEnrol(WaitingRequest[tunnel_answers.KitParts], frozen=True, tag="host enrol"):
    """A host at the real address `peer` enrols itself with its token and a signing request (PEM)."""

    token: str
    request: str
    peer: str


@rest(
    "admin", "POST", "/v1/hosts/{name}/kit", name="new_host_kit", body=bodies.NewKit, of=HOSTS, problems=_NO_HOST,
    seconds=_CHARON_SECONDS, filled=("request",), good="The kit: an archive (.tar.gz)", machine_only=_KIT,
)  # fmt: skip
class HostRenew(WaitingRequest[tunnel_answers.KitParts], frozen=True, tag="host renew"):
    """A new certificate for an enrolled host, in a kit; the earlier one is revoked and its tunnel closed."""

    name: OneHost
    request: str
    days: float = 90
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
class HostEndpoint(AdminRequest[tunnel_answers.Endpoint], frozen=True, tag="host endpoint"):
    """The address at which hosts reach the appliance unless one is given: `endpoint`, with the `reason`."""


@rest("operator")
class HostKit(AdminRequest[tunnel_answers.KitParts], frozen=True, tag="host kit"):
    """The parts of an enrolled host's kit, without its private key."""

    name: str


@rest("admin", "DELETE", "/v1/hosts/{name}", name="revoke_host", of=HOSTS, problems=_NO_HOST)
class HostRevoke(AdminRequest[tunnel_answers.Revoked], frozen=True, tag="host revoke"):
    """Exclude a host: its certificate, tunnel, registrations and connections end within a second."""

    name: OneHost
    expected: int | None = None


@rest(
    "operator", "PUT", "/v1/hosts/{name}/ports", name="tell_host_ports", body=bodies.PortsTold, of=HOSTS,
    problems=_NO_HOST, answer_field="ports",
)  # fmt: skip
class HostPorts(AdminRequest[tunnel_answers.PortsReport], frozen=True, tag="host ports"):
    """Report whether the ROS ports of a host are closed, as `rosrv protect --check` found from outside."""

    name: Annotated[
        str,
        parameter(
            "name of the host, or a machine's address", min_length=1, max_length=63, examples=["ocu-1"]
        ),
    ]
    state: Literal["closed", "open", "unknown"]
    open: list[int] = []  # noqa: RUF012  each struct gets one of its own
    checked: float | None = None  # seconds since the epoch; None: now
    expected: int | None = None


@rest("operator", "POST", "/v1/hosts/reload", name="reload_hosts", of=HOSTS)
class HostsReload(AdminRequest[tunnel_answers.Reloaded], frozen=True, tag="hosts reload"):
    """Read hosts.yaml again, and open and close tunnels accordingly. Enrolments and revocations do not change."""

    expected: int | None = None


@rest(None)
class RevocationsWanted(AdminRequest[tunnel_answers.RevocationList], frozen=True, tag="host revocations"):
    """The authority's signed list of revoked certificates, in PEM."""


@rest(None)
class AuthorityWanted(AdminRequest[tunnel_answers.AuthorityCertificate], frozen=True, tag="host authority"):
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
