"""Define the bodies of REST requests about hosts in tunnels. An unknown field is an error."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.answers.field_docs import doc
from appliance.channel.answers.host_answers import PortsState
from appliance.channel.rest_bodies import WHOLE

HOST_NAME = r"^[A-Za-z0-9](?:[A-Za-z0-9._-]{0,61}[A-Za-z0-9])?$"
ENDPOINT = r"^[A-Za-z0-9][A-Za-z0-9.:-]{0,252}$"
PORTS = r"^[0-9]{1,5}(?:-[0-9]{1,5})?$"
SERVICE = r"^(?:tcp|udp)/[0-9]{1,5}(?:-[0-9]{1,5})?$"
LONGEST_REQUEST = 16 << 10
LONGEST_DAYS = 398
LONGEST_TOKEN_SECONDS = 7 * 86_400
HostName = Annotated[str, doc("name of the host, `host:NAME` in the policy", pattern=HOST_NAME + WHOLE)]
Endpoint = Annotated[str, msgspec.Meta(pattern=ENDPOINT + WHOLE)]
Service = Annotated[str, msgspec.Meta(pattern=SERVICE + WHOLE)]
Address = Annotated[str, msgspec.Meta(max_length=64)]
Port = Annotated[int, msgspec.Meta(ge=1, le=65_535)]
Days = Annotated[float, doc("until the certificate ends", gt=0, le=LONGEST_DAYS)]
TokenSeconds = Annotated[float, msgspec.Meta(ge=60, le=LONGEST_TOKEN_SECONDS)]
SigningRequest = Annotated[str, doc("PKCS #10, in PEM", min_length=1, max_length=LONGEST_REQUEST)]
GivenMoment = (
    Annotated[float, msgspec.Meta(ge=0, le=4_000_000_000)] | Annotated[str, msgspec.Meta(max_length=64)]
)


class KitWishes(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The contents of a kit besides the certificate."""

    endpoint: Annotated[
        Endpoint | None,
        doc(
            "address or name at which the host reaches the appliance; by default, `ipsec.endpoint` of the"
            " configuration, else the machine's address towards its default route (422 if it has none)"
        ),
    ] = None
    ports: Annotated[
        str, doc("the host's local port range, which its firewall closes", pattern=PORTS + WHOLE)
    ] = "32768-60999"
    open: Annotated[
        list[Service], doc("the host's services that stay open, such as tcp/22", max_length=100)
    ] = []


class TokenWishes(KitWishes, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A one-time token for a host, new or enrolled before."""

    address: Annotated[Address | None, doc("its virtual address; by default, the next free one")] = None
    days: Days = 90
    token_seconds: Annotated[TokenSeconds, doc("seconds for which the one-time token is valid")] = 3600


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


class PortsTold(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The findings of `rosrv protect --check`."""

    state: Annotated[PortsState, doc("its state")]
    open: Annotated[list[Port], doc("TCP ports that accepted a connection", max_length=100)] = []
    checked: Annotated[GivenMoment | None, doc("RFC 3339, or seconds since the epoch; by default, now")] = (
        None
    )
