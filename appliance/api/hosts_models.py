"""What `/v1/hosts` and `/v1/enrol` take and give besides what RVMaster answers. Taken is what is named, exactly."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.answers.field_docs import Moment, told
from appliance.channel.answers.host_answers import PortsState

HOST_NAME = r"^[A-Za-z0-9](?:[A-Za-z0-9._-]{0,61}[A-Za-z0-9])?$"
ENDPOINT = r"^[A-Za-z0-9][A-Za-z0-9.:-]{0,252}$"
PORTS = r"^[0-9]{1,5}(?:-[0-9]{1,5})?$"
SERVICE = r"^(?:tcp|udp)/[0-9]{1,5}(?:-[0-9]{1,5})?$"
TOKEN = r"^rosrv-enrol_[0-9a-f]{12}_[A-Za-z0-9_-]{43}$"  # noqa: S105  the form of one
PROOF = r"^[A-Za-z0-9+/]+={0,2}$"
_WHOLE = r"(?!\n)"  # after `$`, which Python finds before a last newline, too
LONGEST_REQUEST = 16 << 10
LONGEST_DAYS = 398
LONGEST_TOKEN_SECONDS = 7 * 86_400

Name = Annotated[str, told("`host:NAME` in the policy", pattern=HOST_NAME + _WHOLE)]
Endpoint = Annotated[str, msgspec.Meta(pattern=ENDPOINT + _WHOLE)]
Service = Annotated[str, msgspec.Meta(pattern=SERVICE + _WHOLE)]
Address = Annotated[str, msgspec.Meta(max_length=64)]
Port = Annotated[int, msgspec.Meta(ge=1, le=65_535)]
GivenMoment = (
    Annotated[float, msgspec.Meta(ge=0, le=4_000_000_000)] | Annotated[str, msgspec.Meta(max_length=64)]
)
Days = Annotated[float, told("until the certificate ends", gt=0, le=LONGEST_DAYS)]
TokenSeconds = Annotated[float, msgspec.Meta(ge=60, le=LONGEST_TOKEN_SECONDS)]
SigningRequest = Annotated[str, told("PKCS #10, in PEM", min_length=1, max_length=LONGEST_REQUEST)]


class KitWishes(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What goes into a kit besides the certificate."""

    endpoint: Annotated[
        Endpoint | None,
        told(
            "address or name at which the host reaches the appliance; null: `ipsec.endpoint` of the configuration, else"
            " the machine's address towards its default route (422 when that cannot be told)"
        ),
    ] = None
    ports: Annotated[
        str, told("the host's local port range, which its firewall closes", pattern=PORTS + _WHOLE)
    ] = "32768-60999"
    open: Annotated[
        list[Service], told("services of the host that stay open, such as tcp/22", max_length=100)
    ] = []


class TokenWishes(KitWishes, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A one-time token for a host, new or enrolled before."""

    address: Annotated[Address | None, told("its virtual address; null: the next free one")] = None
    days: Days = 90
    token_seconds: TokenSeconds = 3600


class NewHost(TokenWishes, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A host to enrol."""

    name: Name
    how: Annotated[
        Literal["token", "kit"],
        told(
            "token: the host makes its own key and brings a one-time token (POST /v1/enrol); kit: an archive with a"
            " private key in it, to be carried there"
        ),
    ] = "token"
    request: Annotated[
        SigningRequest | None,
        told("with how=kit: of a key that the host has; the kit has no private key then"),
    ] = None


class NewKit(KitWishes, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A new certificate for an enrolled host, in a kit; the one before is revoked."""

    days: Days = 90
    request: SigningRequest | None = None


class Enrolment(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a host brings to be enrolled."""

    token: Annotated[str, msgspec.Meta(pattern=TOKEN + _WHOLE)]
    request: SigningRequest


class Enrolled(msgspec.Struct, frozen=True, kw_only=True):
    """A host is enrolled; `files` are those of its kit, by path, all but the private key."""

    name: str
    address: str
    appliance: Annotated[str, told("the appliance's address in the tunnel")]
    master: Annotated[str, told("ROS_MASTER_URI through the tunnel")]
    serial: str
    expires: Moment
    certificate: str
    authority: str
    warning: str | None
    files: dict[str, str]


class Renewal(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A signing request for a new key, and the present key's signature over its bytes (base64)."""

    request: SigningRequest
    proof: Annotated[str, msgspec.Meta(min_length=1, max_length=1024, pattern=PROOF + _WHOLE)]


class PortsTold(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What `rosrv protect --check` saw."""

    state: PortsState
    open: Annotated[list[Port], msgspec.Meta(max_length=100)] = []
    checked: Annotated[GivenMoment | None, told("RFC 3339, or seconds since the epoch; null: now")] = None
