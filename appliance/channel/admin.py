"""What operators' tools ask of the running appliance; the base of each request names the struct that answers it.

Over the admin socket: one JSON document per line in each direction, one request per connection at a time. The
socket is in the state directory, for its owner and root only, and takes `AnyRequest`: all but `ChallengeWanted`. Over
REST the api process passes on `RestRequest`, all that has `@rest`, and gets the same document back. `@rest` says which
HTTP request asks it, and the least role that may: the command line makes its calls from that, control derives from it
once more what a client has signed and who may ask it, and a test holds the api's routes against it.

`expected` is the revision that the asker has seen: a change is refused when another one is in force by now.
"""

import functools
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Generic, Literal, NamedTuple, TypeVar, Union, cast, get_args

import msgspec

from appliance.channel.answers import (
    evidence_answers,
    graph_answers,
    host_answers,
    inventory_answers,
    measures,
    monitor_answers,
    policy_answers,
    recording_answers,
    status,
    token_answers,
)
from appliance.channel.answers.token_answers import TokenRole

A = TypeVar("A")
PARAMETERS = {"names": "name", "topics": "topic"}
"""What a field is called in a query, where it may stand there several times."""

_WITHIN = ("confirm_within",)
_LOADED = (*_WITHIN, "force", "shadow")


class AdminRequest(msgspec.Struct, Generic[A], frozen=True, tag_field="verb", forbid_unknown_fields=True):
    """A question or an order to the running appliance, which an `A` answers."""


class WaitingRequest(AdminRequest[A], Generic[A], frozen=True):
    """One whose answer waits for charon, the signer, the recorder or a topic's messages: others go past it."""


R = TypeVar("R", bound=AdminRequest[Any])


class Operation(NamedTuple):
    """How one thing is asked over REST; `role` None: without a token. Without a path the api asks it to answer others.

    A field of the request stands in the path (of a list: the only element), in the query, in `If-Match` (`expected`),
    or else in the body, under its name. `says` is what the body has besides; `fixed` are fields that the operation
    stands for. Both tell the operations of one path apart: the first that fits is meant.
    """

    request: type[AdminRequest[Any]]
    role: TokenRole | None
    method: str
    path: str
    query: tuple[str, ...]
    says: Mapping[str, Any]
    fixed: Mapping[str, Any]

    def body(self) -> list[msgspec.structs.FieldInfo]:
        """The fields that the body has."""
        elsewhere = {"expected", *self.query, *self.fixed}
        fields = msgspec.structs.fields(self.request)
        return [
            field for field in fields if field.name not in elsewhere and f"{{{field.name}}}" not in self.path
        ]


_OPERATIONS: dict[type, tuple[Operation, ...]] = {}


def rest(
    role: TokenRole | None,
    method: str = "",
    path: str = "",
    query: tuple[str, ...] = (),
    *,
    says: Mapping[str, Any] = {},
    fixed: Mapping[str, Any] = {},
) -> Callable[[type[R]], type[R]]:
    """The request is asked over REST in this way, besides those that stand below this one."""

    def add(request: type[R]) -> type[R]:
        operation = Operation(request, role, method, path, query, says, fixed)
        _OPERATIONS[request] = (operation, *_OPERATIONS.get(request, ()))
        return request

    return add


def verb_of(request: AdminRequest[Any]) -> str:
    """The name of a request, as it stands in `verb`."""
    return str(type(request).__struct_config__.tag)


@rest("viewer", "GET", "/v1/status")
class StatusWanted(AdminRequest[status.Status], frozen=True, tag="status"):
    """The running appliance: processes, isolation, policy, graph, audit log."""


@rest("viewer", "GET", "/v1/inventory")
class InventoryWanted(AdminRequest[inventory_answers.Inventory], frozen=True, tag="inventory"):
    """What runs: version, build, parts with their licences, what is used of the kernel."""


@rest("operator", "POST", "/v1/policy/reload", _WITHIN)
class PolicyReload(AdminRequest[policy_answers.Loaded], frozen=True, tag="policy reload"):
    """Read the policy file again; back by itself after `confirm_within` seconds unless confirmed."""

    confirm_within: float | None = None
    expected: int | None = None


@rest("operator", "POST", "/v1/policy/rollback")
class PolicyRollback(AdminRequest[policy_answers.Loaded], frozen=True, tag="policy rollback"):
    """Back to a kept revision; None: the one before the present."""

    revision: int | None = None
    expected: int | None = None


@rest("operator", "POST", "/v1/policy/confirm")
class PolicyConfirm(AdminRequest[policy_answers.PolicyConfirmed], frozen=True, tag="policy confirm"):
    """Keep a change that would go back by itself."""

    expected: int | None = None


@rest("admin", "POST", "/v1/policy", _WITHIN)
class PolicyLoad(AdminRequest[policy_answers.Loaded], frozen=True, tag="policy load"):
    """Bring a text into force that is not the file's: check, test, swap, decide again what is live."""

    text: str
    note: str = ""
    confirm_within: float | None = None
    expected: int | None = None
    signature: str = ""


@rest("viewer")
class PolicyWanted(AdminRequest[policy_answers.PolicyKnown], frozen=True, tag="policy"):
    """The text of a revision (None: the one in force), and with what it is judged: its tests, the robot."""

    revision: int | None = None


@rest("viewer", "GET", "/v1/policy/revisions")
class PolicyRevisions(AdminRequest[policy_answers.PolicyRevisionList], frozen=True, tag="policy revisions"):
    """The kept revisions, the newest first."""


@rest("viewer")
class RegistrationsWanted(AdminRequest[graph_answers.Registrations], frozen=True, tag="registrations"):
    """What is live now and a change of the policy may end."""


@rest("viewer", "GET", "/v1/graph")
class GraphWanted(AdminRequest[graph_answers.Graph], frozen=True, tag="graph"):
    """Nodes, topics and services, who is mediated, and rates."""


@rest("operator", "GET", "/v1/messages", ("topic", "messages", "seconds", "latched"))
class TopicLook(WaitingRequest[graph_answers.TopicMessages], frozen=True, tag="topic look"):
    """The next messages of a topic, read as fields; it is recorded who looked. At most 20, and for ten seconds.

    `latched`: what its publishers latched comes first; whoever looks on has it already.
    """

    topic: str
    messages: int = 1
    seconds: float = 2.0
    latched: bool = True


@rest(None)
class MetricsWanted(AdminRequest[measures.Measures], frozen=True, tag="metrics"):
    """The status, and everything that control counts."""


@rest("viewer", "GET", "/v1/monitors", ("texts",))
class MonitorsWanted(AdminRequest[monitor_answers.Monitors], frozen=True, tag="monitors"):
    """The monitors with their state and counters; with `texts`, also the specifications themselves."""

    texts: bool = False


@rest("admin", "POST", "/v1/monitors", _LOADED)
class MonitorLoad(AdminRequest[monitor_answers.Replaced], frozen=True, tag="monitor load"):
    """Add or replace files of specifications, and the message definitions they need (`package/Type.msg`).

    `signatures` are the site's, by the names of both.
    Of this and every change below, `expected` is the tag of the monitors that it is meant for; None for any. What is
    loaded or removed goes back by itself after `confirm_within` seconds unless confirmed. With `shadow` the
    monitors come into force in shadow mode; with `force` also where that cuts a topic whose publisher has another type.
    """

    files: dict[str, str]
    definitions: dict[str, str] = {}
    note: str = ""
    expected: str | None = None
    confirm_within: float | None = None
    signatures: dict[str, str] = {}
    force: bool = False
    shadow: bool = False


@rest("operator")
class MonitorTry(WaitingRequest[monitor_answers.Tried], frozen=True, tag="monitor try"):
    """What loading these would do (see `MonitorLoad`): they are compiled, and nothing changes."""

    files: dict[str, str]
    definitions: dict[str, str] = {}
    signatures: dict[str, str] = {}
    expected: str | None = None
    force: bool = False
    shadow: bool = False


@rest("admin", "PUT", "/v1/monitors/{name}", _LOADED)
class MonitorReplace(AdminRequest[monitor_answers.Replaced], frozen=True, tag="monitor replace"):
    """Put a text in the place of the file that the monitor `name` stands in, or of the file of this name.

    `signatures` are those of the definitions.
    """

    name: str
    text: str
    definitions: dict[str, str] = {}
    note: str = ""
    expected: str | None = None
    confirm_within: float | None = None
    signature: str = ""
    signatures: dict[str, str] = {}
    force: bool = False
    shadow: bool = False


@rest("operator", "POST", "/v1/monitors/reload", ("prune", *_LOADED))
class MonitorReload(AdminRequest[monitor_answers.Replaced], frozen=True, tag="monitor reload"):
    """Take what the folder of specifications has now; what it does not have stays, unless `prune`."""

    expected: str | None = None
    prune: bool = False
    confirm_within: float | None = None
    force: bool = False
    shadow: bool = False


@rest("admin", "DELETE", "/v1/monitors", ("names", "confirm_within"))
@rest("admin", "DELETE", "/v1/monitors/{names}", _WITHIN)
class MonitorRemove(AdminRequest[monitor_answers.Replaced], frozen=True, tag="monitor remove"):
    """Remove specifications, by the names of their files or monitors."""

    names: list[str]
    expected: str | None = None
    confirm_within: float | None = None


@rest("admin", "POST", "/v1/monitors/rollback")
class MonitorRollback(AdminRequest[monitor_answers.Replaced], frozen=True, tag="monitor rollback"):
    """Back to a kept revision; None: the one before the present."""

    revision: int | None = None
    expected: str | None = None


@rest("operator", "POST", "/v1/monitors/confirm")
class MonitorConfirm(AdminRequest[monitor_answers.MonitorsConfirmed], frozen=True, tag="monitor confirm"):
    """Keep specifications that would go back by themselves."""

    expected: str | None = None


@rest("viewer", "GET", "/v1/monitors/revisions")
class MonitorRevisions(
    AdminRequest[monitor_answers.MonitorRevisionList], frozen=True, tag="monitor revisions"
):
    """The kept revisions of the specifications."""


@rest("viewer", "GET", "/v1/monitors/revisions/{revision}")
class MonitorRevisionWanted(AdminRequest[monitor_answers.RevisionTexts], frozen=True, tag="monitor revision"):
    """The texts of a kept revision."""

    revision: int


@rest("operator", "PATCH", "/v1/monitors")
@rest("operator", "PATCH", "/v1/monitors/{names}")
class MonitorSwitch(AdminRequest[monitor_answers.Switched], frozen=True, tag="monitor switch"):
    """Let the events of these monitors happen, or not: for `for_seconds`, or (None) until they are enabled again."""

    names: list[str]
    enabled: bool
    expected: str | None = None
    for_seconds: float | None = None


@rest("operator", "PATCH", "/v1/monitors", ("force",))
@rest("operator", "PATCH", "/v1/monitors/{names}", ("force",))
class MonitorShadow(AdminRequest[monitor_answers.Switched], frozen=True, tag="monitor shadow"):
    """Put these monitors into shadow mode, or (false) bring those in shadow mode into force; `force` as of a load."""

    names: list[str]
    shadow: bool
    expected: str | None = None
    force: bool = False


@rest("operator", "PATCH", "/v1/monitors")
@rest("operator", "PATCH", "/v1/monitors/{names}")
class MonitorTrial(AdminRequest[monitor_answers.Switched], frozen=True, tag="monitor trial"):
    """The same under the name of earlier versions; deprecated."""

    names: list[str]
    trial: bool
    expected: str | None = None


@rest("operator", "PATCH", "/v1/monitors", says={"held": False})
@rest("operator", "PATCH", "/v1/monitors/{names}", says={"held": False})
class MonitorResume(AdminRequest[monitor_answers.Switched], frozen=True, tag="monitor resume"):
    """Let the topics that these monitors hold go on."""

    names: list[str]
    expected: str | None = None


@rest("viewer", "GET", "/v1/recordings")
class RecordingsWanted(WaitingRequest[recording_answers.Recordings], frozen=True, tag="recordings"):
    """The recordings that are kept."""


@rest("viewer", "GET", "/v1/recordings/{id}")
class RecordingWanted(WaitingRequest[recording_answers.Recording], frozen=True, tag="recording"):
    """One of them."""

    id: str


@rest("operator", "POST", "/v1/recordings")
class RecordNow(WaitingRequest[recording_answers.RecordingBegun], frozen=True, tag="record now"):
    """Record from `before` seconds before now to `after` seconds after; None: as configured."""

    before: float | None = None
    after: float | None = None
    note: str = ""


@rest("investigator", "GET", "/v1/recordings/{id}/bag")
class RecordingFetch(WaitingRequest[recording_answers.Recording], frozen=True, tag="recording fetch"):
    """Somebody takes the messages of a recording: it is recorded who."""

    id: str


@rest("investigator", "GET", "/v1/recordings/{id}/messages", ("topics",))
class RecordingRead(WaitingRequest[recording_answers.Recording], frozen=True, tag="recording read"):
    """Somebody reads messages of a recording, of these topics (none: of all): it is recorded who."""

    id: str
    topics: list[str] = []


@rest("investigator", "POST", "/v1/recordings/memory")
class RecordingOfMemory(WaitingRequest[recording_answers.Recording], frozen=True, tag="recording memory"):
    """What is in memory, to be read: from `since` to `until`, nanoseconds since the epoch (None: all, now).

    It is no recording that is kept: for ten minutes, or until somebody else asks, it can be fetched as one.
    """

    since: int | None = None
    until: int | None = None


@rest("admin", "DELETE", "/v1/recordings/{id}")
class RecordingRemove(WaitingRequest[recording_answers.Recording], frozen=True, tag="recording remove"):
    """Remove a recording."""

    id: str


class TokenAdd(AdminRequest[token_answers.NewToken], frozen=True, tag="token add"):
    """Make a token that ends after `seconds`; the answer is the only place where its text ever stands."""

    name: str
    role: TokenRole
    seconds: float


@rest("admin", "GET", "/v1/tokens")
class TokenList(AdminRequest[token_answers.Tokens], frozen=True, tag="token list"):
    """All access tokens that were made, without their secrets; for admins."""


@rest("admin", "DELETE", "/v1/tokens/{name}")
class TokenRevoke(AdminRequest[token_answers.Token], frozen=True, tag="token revoke"):
    """End a token now."""

    name: str


@rest("admin", "POST", "/v1/hosts", says={"how": "token"}, fixed={"new": True})
@rest("admin", "POST", "/v1/hosts/{name}/token", fixed={"new": False})
class HostToken(WaitingRequest[host_answers.EnrolmentToken], frozen=True, tag="host token"):
    """Make a token by which a host enrols itself once within `token_seconds`; an earlier one of the name ends.

    Its text is in the answer and nowhere else. `endpoint` (None: the appliance finds it), `ports` and `open` are kept
    with it for whoever makes the host's kit. With `new` it is refused for a host that is enrolled; else such a host
    may come with another key.
    """

    name: str
    endpoint: str | None = None
    ports: str = "32768-60999"
    open: list[str] = []
    token_seconds: float = 3600
    days: float = 90
    address: str | None = None
    expected: int | None = None
    new: bool = False


@rest("admin", "POST", "/v1/hosts", says={"how": "kit"})
class HostAdd(WaitingRequest[host_answers.KitParts], frozen=True, tag="host add"):
    """Enrol a host by a signing request (PKCS #10, PEM) for the key that it has, for `days`.

    `address`: the virtual address it shall have; None: the next free one.
    """

    name: str
    request: str
    days: float = 90
    address: str | None = None
    expected: int | None = None


@rest(None)
class HostEnrol(WaitingRequest[host_answers.KitParts], frozen=True, tag="host enrol"):
    """The host itself, at the real address `peer`, brings its token and a signing request (PEM)."""

    token: str
    request: str
    peer: str


@rest("admin", "POST", "/v1/hosts/{name}/kit")
class HostRenew(WaitingRequest[host_answers.KitParts], frozen=True, tag="host renew"):
    """A new certificate for an enrolled host; the one before is revoked."""

    name: str
    request: str
    days: float = 90
    expected: int | None = None


@rest(None)
class HostRenewItself(WaitingRequest[host_answers.NewCertificate], frozen=True, tag="host renew itself"):
    """A host asks through its tunnel, at its virtual address `peer`, for a certificate for a new key.

    `proof` is the signature of its present key over the bytes of `request`. The certificate before is good until
    `HostRenewed`.
    """

    name: str
    request: str
    proof: bytes
    peer: str


@rest(None)
class HostRenewed(AdminRequest[host_answers.Renewed], frozen=True, tag="host renewed"):
    """A host at its virtual address `peer` has put its new certificate in place: the one before ends now."""

    name: str
    peer: str


@rest("viewer", "GET", "/v1/hosts")
class HostList(AdminRequest[host_answers.Hosts], frozen=True, tag="host list"):
    """All hosts that were enrolled or declared, with their tunnels."""


@rest("viewer")
class HostEndpoint(AdminRequest[host_answers.Endpoint], frozen=True, tag="host endpoint"):
    """At which address hosts reach the appliance, where nobody says it: `endpoint`, and `reason`: why that one."""


@rest("operator")
class HostKit(AdminRequest[host_answers.KitParts], frozen=True, tag="host kit"):
    """What an enrolled host's kit is made of, without its private key."""

    name: str


@rest("admin", "DELETE", "/v1/hosts/{name}")
class HostRevoke(AdminRequest[host_answers.Revoked], frozen=True, tag="host revoke"):
    """Let a host in no more, and cut what it has, now."""

    name: str
    expected: int | None = None


@rest("operator", "PUT", "/v1/hosts/{name}/ports")
class HostPorts(AdminRequest[host_answers.PortsTold], frozen=True, tag="host ports"):
    """Somebody tried the ROS ports of a host from outside, at `checked` (seconds since the epoch; None: now).

    `name` is an enrolled or declared host's, or an address of a machine that nodes run on.
    """

    name: str
    state: Literal["closed", "open", "unknown"]
    open: list[int] = []
    checked: float | None = None
    expected: int | None = None


@rest("operator", "POST", "/v1/hosts/reload")
class HostsReload(AdminRequest[host_answers.Reloaded], frozen=True, tag="hosts reload"):
    """Read `ipsec/hosts.yaml` again."""

    expected: int | None = None


@rest(None)
class RevocationsWanted(AdminRequest[host_answers.RevocationList], frozen=True, tag="host revocations"):
    """The authority's signed list of revoked certificates, in PEM."""


@rest(None)
class AuthorityWanted(AdminRequest[host_answers.AuthorityCertificate], frozen=True, tag="host authority"):
    """The authority's certificate, in PEM."""


@rest("viewer")
class LogSealed(WaitingRequest[evidence_answers.Sealed], frozen=True, tag="audit seal"):
    """Have all that was recorded sealed by a signed checkpoint, now."""


@rest("viewer")
class EvidenceExported(WaitingRequest[evidence_answers.Sealed], frozen=True, tag="evidence exported"):
    """Record that a bundle was made whose manifest has this hash, and have that sealed.

    It has so many `records`, from `since` until before `until` (nanoseconds since the epoch), and the `recording` of
    this id.
    """

    manifest: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
    since: int
    until: int
    records: int
    recording: str = ""


@rest("viewer", "GET", "/v1/challenge")
class ChallengeWanted(AdminRequest[token_answers.Challenge], frozen=True, tag="challenge"):
    """A challenge: an order that changes something is signed under one, and each is good once."""


OPERATIONS = tuple(operation for operations in _OPERATIONS.values() for operation in operations)
CHANGES = frozenset(
    operation.request for operation in OPERATIONS if operation.path and operation.method != "GET"
)
"""What changes something in the name of a token: control makes it only with the request that asked for it."""

ORDERS = CHANGES | {HostEnrol, HostRenewItself, HostRenewed}
"""What changes something over REST, also in the name of a host itself."""

if TYPE_CHECKING:
    RestRequest = AdminRequest[Any]
    AnyRequest = AdminRequest[Any]
else:
    RestRequest = Union[tuple(_OPERATIONS)]  # noqa: UP007  there are as many as there are
    AnyRequest = Union[(TokenAdd, *(request for request in _OPERATIONS if request is not ChallengeWanted))]


def operation_of(request: AdminRequest[Any]) -> Operation | None:
    """How a request is asked; None: not over REST."""
    for operation in _OPERATIONS.get(type(request), ()):
        if all(getattr(request, name) == operation.fixed[name] for name in operation.fixed):
            return operation
    return None


Trouble = Literal["", "request", "refused", "conflict", "unknown", "forbidden", "busy", "failed"]


class AdminAnswer(msgspec.Struct, Generic[A], frozen=True):
    """The answer: `ok` with a body, or an error with its findings.

    `trouble` says whose fault an error is: `request` (it makes no sense), `refused` (the policy or name given is
    wrong), `conflict` (another revision is in force than was expected: `tag` is that of the monitors), `unknown` (there
    is no such thing), `forbidden` (whoever asks may not), `busy` (too much at once), `failed` (the appliance cannot do
    it now).
    """

    ok: bool
    body: A | None = None
    error: str = ""
    findings: list[str] = []
    trouble: Trouble = ""
    tag: str = ""

    def given(self) -> A:
        """The body of an answer that is `ok`."""
        assert self.body is not None  # noqa: S101  it has one
        return self.body


encode = msgspec.json.Encoder().encode


@functools.cache
def _decoder(kind: type[AdminRequest[A]]) -> msgspec.json.Decoder[AdminAnswer[A]]:
    return msgspec.json.Decoder(AdminAnswer[answer_to(kind)])  # type: ignore[misc]  # known when it runs only


def answer_to(kind: type[AdminRequest[A]]) -> type[A]:
    """The struct that answers such a request."""
    (answer,) = get_args(kind.__orig_bases__[0])  # type: ignore[attr-defined]  # what `typing` keeps of its bases
    return cast(type[A], answer)


def decode(document: bytes, request: AdminRequest[A]) -> AdminAnswer[A]:
    """The answer to a request. Raises `msgspec.MsgspecError` when it is none."""
    return _decoder(type(request)).decode(document)
