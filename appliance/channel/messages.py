"""Every message that crosses a process boundary of the appliance, by link.

A message is a frozen struct with a tag of its own name; a link accepts only the messages of its union, so a
process cannot be told anything that is not written here. A struct that travels with file descriptors says so in
`descriptors`; they are sent as SCM_RIGHTS with the message and delivered with it.

Strings from strangers (names, header values) are carried as values and never interpreted on the way.
"""

from typing import Annotated, Any, ClassVar, Literal

import msgspec

from appliance.channel.admin import AdminAnswer, RestRequest


class Message(msgspec.Struct, frozen=True, tag=True, tag_field="message", forbid_unknown_fields=True):
    """A message between two processes of the appliance."""

    descriptors: ClassVar[int] = 0


# --- lifeline: supervisor <-> any child -------------------------------------------------------------------


class Ping(Message):
    """Supervisor asks a child whether it is alive; unanswered for 5 s, the child is killed and restarted."""

    number: int


class Pong(Message):
    """A child's answer to `Ping`, sent from its main loop."""

    number: int


class Stop(Message):
    """Supervisor asks a child to end cleanly; it has 3 s."""


class Ready(Message):
    """A child is in service. For control: nodes may connect. `detail` is for status (addresses, ports).

    Control's `detail` has `master` (the URI nodes are told), `revision` (of the policy), `rosout_master` (the URI
    of the loopback listener for the appliance's own nodes), `inner_port` (of the inner faces) and `token` (the
    first access token of REST, if it was made at this start).
    """

    detail: dict[str, Any] = {}


class Failed(Message):
    """A child cannot serve and says why; the supervisor shows it and stops the appliance."""

    reason: str


class LinkOpened(Message):
    """Supervisor hands a child its end of a new link to another process (replaces an earlier one)."""

    descriptors: ClassVar[int] = 1
    role: str
    index: int


class SocketKept(Message):
    """Control gives the supervisor a listening socket to keep over control's death (name is unique)."""

    descriptors: ClassVar[int] = 1
    name: str


class SocketDropped(Message):
    """Control no longer needs a kept socket."""

    name: str


class SocketRestored(Message):
    """Supervisor gives a restarted control one kept socket back, or the api the one it serves (`api`)."""

    descriptors: ClassVar[int] = 1
    name: str


class SocketsRestored(Message):
    """All kept sockets have been given back; sent at every start of control, also when there are none."""

    count: int


class ProcessInfo(msgspec.Struct, frozen=True):
    """One process of the appliance as `rosrv status` shows it; `since` is RFC 3339 UTC."""

    role: str
    pid: int
    since: str
    restarts: int


class ProcessesChanged(Message):
    """Supervisor tells control which processes run; sent at start and after every start or death."""

    processes: list[ProcessInfo]


class FirewallReported(Message):
    """Supervisor tells control the state of isolation and firewall for `rosrv status`."""

    isolation: str
    report: dict[str, Any]


class ProbeFailed(Message):
    """The ROSMaster port could be reached by another user: control stops serving nodes and says why."""

    reason: str


class ProbePassed(Message):
    """The ROSMaster port is hidden (again)."""


class PolicyReloadRequested(Message):
    """Supervisor got SIGHUP: control reads the policy file again, as `rosrv policy reload` would."""


class RouteWanted(Message):
    """Control asks which address of the machine a host uses to reach the appliance (netns isolation)."""

    host: str


class RouteFound(Message):
    """Supervisor's answer to `RouteWanted`; `address` is None where the peer's own route is the right one."""

    host: str
    address: str | None


class ApplianceStopRequested(Message):
    """Control asks the supervisor to end the appliance (the `shutdown` call of the Master API, granted)."""

    reason: str


class SignatureWanted(Message):
    """Control asks the signer to sign an audit checkpoint."""

    number: int
    text: bytes


class SignatureMade(Message):
    """The signer's Ed25519 signature (64 bytes) over `SignatureWanted.text`, and its raw public key (32)."""

    number: int
    signature: bytes
    public_key: bytes


class SignatureRefused(Message):
    """The signer will not sign this checkpoint (it does not follow what was signed before) and says why."""

    number: int
    reason: str


class AuthorityWanted(Message):
    """Control asks the signer for the certificate of the appliance's authority; `number` pairs all these."""

    number: int


class AuthorityStated(Message):
    """The authority's certificate, in PEM."""

    number: int
    certificate: bytes


class CertificateWanted(Message):
    """Control asks for a certificate in this name for the key of a signing request (PKCS #10, PEM)."""

    number: int
    request: bytes
    name: str
    days: float


class CertificateMade(Message):
    """The certificate (PEM), its serial number in hexadecimal, and its end in seconds since the epoch."""

    number: int
    certificate: bytes
    serial: str
    expires: float


class CertificateRefused(Message):
    """The signer makes no certificate for this request and says why."""

    number: int
    reason: str


class RevokedCertificate(msgspec.Struct, frozen=True):
    """A serial number in hexadecimal, at most 160 bits, and since when (seconds since the epoch)."""

    serial: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{1,40}$")]
    moment: Annotated[float, msgspec.Meta(ge=0, le=4_000_000_000)]


class RevocationsWanted(Message):
    """Control asks for the signed list of exactly these revoked certificates."""

    number: int
    revoked: list[RevokedCertificate]


class RevocationsMade(Message):
    """The list of revoked certificates (CRL, PEM)."""

    number: int
    revocations: bytes


# --- link: control <-> relay ------------------------------------------------------------------------------
# `key` is the key of an incarnation. Control states what is wanted; the relay reports what it sees.


class StateBegan(Message):
    """Control restates everything: what is not said again before `StateEnded` is gone."""

    epoch: int


class StateEnded(Message):
    """End of the restatement that began with the same epoch."""

    epoch: int


class NodePlaced(Message):
    """An incarnation and the listening socket that stands for its TCPROS port.

    `host` is the address the node is called at, `name` the node's name (its `callerid`). `monitors`: it is the
    appliance's own publisher; what goes out of its port is what monitors publish.
    """

    descriptors: ClassVar[int] = 1
    key: str
    name: str
    host: str
    monitors: bool = False


class NodeWithdrawn(Message):
    """An incarnation is gone: its port is closed, its connections are cut."""

    key: str


class PublicationPlaced(Message):
    """The incarnation publishes this topic (type as registered, `*` when unknown)."""

    key: str
    topic: str
    type: str


class PublicationWithdrawn(Message):
    """The incarnation publishes this topic no longer: its connections are cut."""

    key: str
    topic: str


class ServicePlaced(Message):
    """The incarnation offers this service at `host:port` (TCPROS)."""

    key: str
    service: str
    host: str
    port: int


class ServiceWithdrawn(Message):
    """The incarnation offers this service no longer: its connections are cut."""

    key: str
    service: str


class GrantInstalled(Message):
    """This subscriber (host, caller_id) may have this topic of that incarnation."""

    key: str
    topic: str
    host: str
    caller_id: str


class GrantRevoked(Message):
    """The grant is gone; a connection that stands on it is cut."""

    key: str
    topic: str
    host: str
    caller_id: str


class ClientGranted(Message):
    """This host may call this service of that incarnation."""

    key: str
    service: str
    host: str


class ClientRevoked(Message):
    """The host may no longer call the service; connections that stand on it are cut."""

    key: str
    service: str
    host: str


class UpstreamWanted(Message):
    """The relay needs the publisher's TCPROS address for a topic: control calls `requestTopic` there."""

    key: str
    topic: str


class UpstreamFound(Message):
    """Answer to `UpstreamWanted`: connect here."""

    key: str
    topic: str
    host: str
    port: int


class UpstreamRefused(Message):
    """Answer to `UpstreamWanted`: the publisher cannot be asked or said no; the relay asks again later."""

    key: str
    topic: str
    reason: str


class UpstreamLost(Message):
    """A connection to a publisher broke or could not be made: control looks at the node at once."""

    key: str
    topic: str
    reason: str


class ConnectionOpened(Message):
    """A subscriber (`topic` set) or a client (`service` set) is connected through the relay."""

    number: int
    key: str
    resource: str
    kind: str  # "topic" or "service"
    host: str
    caller_id: str


class ConnectionClosed(Message):
    """A connection that was reported open is closed; `reason` is empty for an orderly end."""

    number: int
    reason: str


class ConnectionRefused(Message):
    """Somebody connected to a relay port and was refused; `resource` is what the header asked for."""

    key: str
    resource: str
    host: str
    caller_id: str
    reason: str
    count: int  # repeated identical refusals are folded


class TopicTraffic(msgspec.Struct, frozen=True, array_like=True):
    """What went through one relayed topic since the last report."""

    key: str
    resource: str
    messages: int
    bytes: int
    dropped: int  # at slow subscribers
    subscribers: int


class TrafficReported(Message):
    """Counters of all relayed topics and services that changed; once a second at most."""

    rows: list[TopicTraffic]


class SpecificationsStated(Message):
    """Control states the specifications in force: before anything is placed, and at every change.

    `files` are pairs of name and text, in order; `definitions` are `.msg` and `.srv` files by name, besides ROS's own.
    `enabled` says of each monitor whether its events happen. `restarted`: a relay that has no specifications yet
    takes the place of one that died, so monitors with the modifier `hold` block their topics.
    """

    revision: int
    files: list[tuple[str, str]]
    definitions: dict[str, str]
    enabled: dict[str, bool]
    restarted: bool
    on_fault: Literal["drop", "pass"] = "drop"


class MonitorSwitched(Message):
    """From now on the events of this monitor happen, or do not."""

    name: str
    enabled: bool


class MonitorResumed(Message):
    """A monitor that holds its topics lets them go on."""

    name: str


class SpecificationsTaken(Message):
    """The relay has these specifications in force. `began` are the monitors that started in their initial state."""

    revision: int
    began: list[str]
    held: list[str]


class SpecificationsRefused(Message):
    """The relay could not take them: what it had stays in force; without any, everything is blocked."""

    revision: int
    findings: list[str]


class PublicationRefused(Message):
    """A publisher (or service) is not carried: its definition is another than the specifications'."""

    key: str
    resource: str
    reason: str


class MonitorEvent(msgspec.Struct, frozen=True, array_like=True):
    """Something a monitor did: the first of its kind and second in full, the others as a count.

    `kind` is verdict, drop, change, fault, log or publish; `time` is nanoseconds since the epoch; `before` and
    `after` are the message, as far as the bound goes (`size` is its whole length). `count` is 0 when told in full,
    else how many more there were.
    """

    kind: str
    monitor: str
    key: str
    resource: str
    time: int
    text: str
    detail: dict[str, Any]
    before: bytes = b""
    after: bytes = b""
    size: int = 0
    count: int = 0


class MonitorsReported(Message):
    """What monitors did; batches, a few a second at most. `lost` could not be kept while there was no control."""

    events: list[MonitorEvent]
    lost: int = 0


class MonitorRow(msgspec.Struct, frozen=True, array_like=True):
    """The state and counters of one running monitor; counters since it was loaded or the relay started."""

    name: str
    file: str
    enabled: bool
    held: bool
    failing: bool
    events: int
    verdicts: int
    drops: int
    changes: int
    faults: int


class MonitorsCounted(Message):
    """All monitors; once a second at most, when something has changed."""

    rows: list[MonitorRow]


# --- link: control <-> api --------------------------------------------------------------------------------
# The api asks on behalf of a token; what it may ask is the union `RestRequest`, which has no way to make a token.


class RequestMade(Message):
    """The api passes on what the holder of the token `who` asks; `number` pairs it with its answer."""

    number: int
    who: str
    request: RestRequest


class RequestAnswered(Message):
    """Control's answer to `RequestMade` with the same number."""

    number: int
    answer: AdminAnswer


class TokenKept(msgspec.Struct, frozen=True):
    """A token that may be used, without its secret; `expires` is seconds since the epoch."""

    id: str
    name: str
    role: str
    salt: bytes
    hash: bytes
    expires: float


class TokensStated(Message):
    """Control tells the api every token that may be used; said at the start of a link and after every change."""

    tokens: list[TokenKept]


class RestCalled(Message):
    """A REST call to be recorded. `who` is the token's name, empty when nobody was recognised.

    `count` equal calls (of one second at least) are one message; `duration_us` is of the first.
    """

    host: str
    who: str
    method: str
    path: str
    status: int
    reason: str
    duration_us: int
    count: int = 1


# --- tunnels: control -> supervisor over the lifeline, control <-> the process that runs charon ------------

Esp = Literal["kernel", "user space"]
APPLIANCE_NAME = "rosrv-appliance"  # in the appliance's own certificate; no host may have it


class TunnelsWanted(Message):
    """Control asks the supervisor for tunnels: addresses of `pool` are accepted through IPsec only from now on,
    the appliance has `address` (in `pool`), and the process that runs charon is there.
    """

    pool: str
    address: str


class TunnelsEnclosed(Message):
    """Answer to `TunnelsWanted`: the firewall is in force and where ESP runs; else `reason` says why not."""

    esp: Esp | None
    reason: str = ""


class CertificateNeeded(Message):
    """charon's process asks for a certificate for the appliance's own key, by a signing request (PEM)."""

    request: bytes


class TunnelHost(msgspec.Struct, frozen=True):
    """A host that may come: its name, the virtual address kept for it, the serial of its certificate."""

    name: str
    address: str
    serial: str


class TunnelsStated(Message):
    """All that charon is to have: certificates and the list of revoked ones in PEM, the hosts that may come."""

    number: int
    esp: Esp
    address: str
    authority: bytes
    certificate: bytes
    revocations: bytes
    hosts: list[TunnelHost]


class TunnelChanged(Message):
    """The tunnel of a host came up from, or went down to, this real address."""

    name: str
    up: bool
    remote: str


class TunnelRefused(Message):
    """Somebody at this real address asked for a tunnel and was refused."""

    remote: str
    reason: str


class TunnelSeen(msgspec.Struct, frozen=True):
    """A tunnel that stands, for so many seconds; bytes as the appliance counts them."""

    name: str
    remote: str
    seconds: int
    bytes_in: int
    bytes_out: int


class TunnelsReported(Message):
    """All tunnels that stand now; charon has taken the statement with the number `taken`."""

    taken: int
    rows: list[TunnelSeen]


TunnelLink = (
    CertificateNeeded | TunnelsStated | TunnelChanged | TunnelRefused | TunnelsReported
)  # fmt: skip

Lifeline = (
    Ping | Pong | Stop | Ready | Failed | LinkOpened | SocketKept | SocketDropped | SocketRestored
    | SocketsRestored | ProcessesChanged | FirewallReported | ProbeFailed | ProbePassed | PolicyReloadRequested
    | RouteWanted
    | TunnelsWanted | TunnelsEnclosed
    | RouteFound | ApplianceStopRequested | SignatureWanted | SignatureMade
)  # fmt: skip

RelayLink = (
    StateBegan | StateEnded | NodePlaced | NodeWithdrawn | PublicationPlaced | PublicationWithdrawn
    | ServicePlaced | ServiceWithdrawn | GrantInstalled | GrantRevoked | ClientGranted | ClientRevoked
    | UpstreamWanted | UpstreamFound | UpstreamRefused | UpstreamLost | ConnectionOpened | ConnectionClosed
    | ConnectionRefused | TrafficReported | SpecificationsStated | MonitorSwitched | MonitorResumed
    | SpecificationsTaken | SpecificationsRefused | PublicationRefused | MonitorsReported | MonitorsCounted
)  # fmt: skip

SignerLink = (
    SignatureWanted | SignatureMade | SignatureRefused | AuthorityWanted | AuthorityStated | CertificateWanted
    | CertificateMade | CertificateRefused | RevocationsWanted | RevocationsMade
)  # fmt: skip

ApiLink = RequestMade | RequestAnswered | TokensStated | RestCalled
