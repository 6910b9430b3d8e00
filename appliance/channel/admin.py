"""What operators' tools ask of the running appliance; the base of each request names the struct that answers it.

Over the admin socket: one JSON document per line in each direction, one request per connection at a time. The
socket is in the state directory, for its owner and root only, and takes `AnyRequest`. Over REST the api process
passes on `RestRequest`, which cannot make tokens, and gets the same document back; which HTTP request asks what is in
`operations.py`.

`expected` is the revision that the asker has seen: a change is refused when another one is in force by now.
"""

import functools
from typing import Annotated, Any, Generic, Literal, TypeVar, cast, get_args

import msgspec

from appliance.channel.answers import (
    evidence,
    graph,
    hosts,
    inventory,
    measures,
    monitors,
    policy,
    recordings,
    status,
    tokens,
)
from appliance.channel.answers.tokens import TokenRole

A = TypeVar("A")


class AdminRequest(msgspec.Struct, Generic[A], frozen=True, tag_field="verb", forbid_unknown_fields=True):
    """A question or an order to the running appliance, which an `A` answers."""


class WaitingRequest(AdminRequest[A], Generic[A], frozen=True):
    """One whose answer waits for charon, the signer, the recorder or a topic's messages: others go past it."""


def verb_of(request: AdminRequest[Any]) -> str:
    """The name of a request, as it stands in `verb`."""
    return str(type(request).__struct_config__.tag)


class StatusWanted(AdminRequest[status.Status], frozen=True, tag="status"):
    """Processes, policy, registry, relay, firewall: what `rosrv status` shows."""


class InventoryWanted(AdminRequest[inventory.Inventory], frozen=True, tag="inventory"):
    """What runs: version, build, parts with their licences, what is used of the kernel."""


class PolicyReload(AdminRequest[policy.Loaded], frozen=True, tag="policy reload"):
    """Read the policy file again; back by itself after `confirm_within` seconds unless confirmed."""

    confirm_within: float | None = None
    expected: int | None = None


class PolicyRollback(AdminRequest[policy.Loaded], frozen=True, tag="policy rollback"):
    """Back to a kept revision; None: the one before the present."""

    revision: int | None = None
    expected: int | None = None


class PolicyConfirm(AdminRequest[policy.PolicyConfirmed], frozen=True, tag="policy confirm"):
    """Keep a change that would go back by itself."""

    expected: int | None = None


class PolicyLoad(AdminRequest[policy.Loaded], frozen=True, tag="policy load"):
    """Bring a text into force that is not the file's: check, test, swap, decide again what is live."""

    text: str
    note: str = ""
    confirm_within: float | None = None
    expected: int | None = None
    signature: str = ""


class PolicyWanted(AdminRequest[policy.PolicyKnown], frozen=True, tag="policy"):
    """The text of a revision (None: the one in force), and with what it is judged: its tests, the robot."""

    revision: int | None = None


class PolicyRevisions(AdminRequest[policy.PolicyRevisionList], frozen=True, tag="policy revisions"):
    """The kept revisions."""


class RegistrationsWanted(AdminRequest[graph.Registrations], frozen=True, tag="registrations"):
    """What is live now and a change of the policy may end."""


class GraphWanted(AdminRequest[graph.Graph], frozen=True, tag="graph"):
    """Nodes, topics and services with who is connected to whom and how much flows."""


class TopicLook(WaitingRequest[graph.TopicMessages], frozen=True, tag="topic look"):
    """The next messages of a topic, read as fields; it is recorded who looked. At most 20, and for ten seconds.

    `latched`: what its publishers latched comes first; whoever looks on has it already.
    """

    topic: str
    messages: int = 1
    seconds: float = 2.0
    latched: bool = True


class MetricsWanted(AdminRequest[measures.Measures], frozen=True, tag="metrics"):
    """The status, and everything that control counts."""


class MonitorsWanted(AdminRequest[monitors.Monitors], frozen=True, tag="monitors"):
    """The monitors with their state and counters; with `texts`, also the specifications themselves."""

    texts: bool = False


class MonitorLoad(AdminRequest[monitors.Replaced], frozen=True, tag="monitor load"):
    """Add or replace files of specifications, and the message definitions they need (`package/Type.msg`).

    `signatures` are the site's, by the names of both.
    Of this and every change below, `expected` is the tag of the monitors that it is meant for; None for any. What is
    loaded or removed goes back by itself after `confirm_within` seconds unless confirmed.
    """

    files: dict[str, str]
    definitions: dict[str, str] = {}
    note: str = ""
    expected: str | None = None
    confirm_within: float | None = None
    signatures: dict[str, str] = {}


class MonitorReplace(AdminRequest[monitors.Replaced], frozen=True, tag="monitor replace"):
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


class MonitorReload(AdminRequest[monitors.Replaced], frozen=True, tag="monitor reload"):
    """Take what the folder of specifications has now; what it does not have stays, unless `prune`."""

    expected: str | None = None
    prune: bool = False
    confirm_within: float | None = None


class MonitorRemove(AdminRequest[monitors.Replaced], frozen=True, tag="monitor remove"):
    """Remove specifications, by the names of their files or monitors."""

    names: list[str]
    expected: str | None = None
    confirm_within: float | None = None


class MonitorRollback(AdminRequest[monitors.Replaced], frozen=True, tag="monitor rollback"):
    """Back to a kept revision; None: the one before the present."""

    revision: int | None = None
    expected: str | None = None


class MonitorConfirm(AdminRequest[monitors.MonitorsConfirmed], frozen=True, tag="monitor confirm"):
    """Keep specifications that would go back by themselves."""

    expected: str | None = None


class MonitorRevisions(AdminRequest[monitors.MonitorRevisionList], frozen=True, tag="monitor revisions"):
    """The kept revisions of the specifications."""


class MonitorRevisionWanted(AdminRequest[monitors.RevisionTexts], frozen=True, tag="monitor revision"):
    """The texts of a kept revision."""

    revision: int


class MonitorSwitch(AdminRequest[monitors.Switched], frozen=True, tag="monitor switch"):
    """Let the events of these monitors happen, or not."""

    names: list[str]
    enabled: bool
    expected: str | None = None


class MonitorTrial(AdminRequest[monitors.Switched], frozen=True, tag="monitor trial"):
    """Put these monitors on trial, or (false) bring those that are on trial into force."""

    names: list[str]
    trial: bool
    expected: str | None = None


class MonitorResume(AdminRequest[monitors.Switched], frozen=True, tag="monitor resume"):
    """Let the topics that these monitors hold go on."""

    names: list[str]
    expected: str | None = None


MonitorChange = (
    MonitorLoad | MonitorReplace | MonitorReload | MonitorRemove | MonitorRollback | MonitorConfirm | MonitorSwitch
    | MonitorTrial | MonitorResume
)  # fmt: skip


class RecordingsWanted(WaitingRequest[recordings.Recordings], frozen=True, tag="recordings"):
    """The recordings that are kept."""


class RecordingWanted(WaitingRequest[recordings.Recording], frozen=True, tag="recording"):
    """One of them."""

    id: str


class RecordNow(WaitingRequest[recordings.RecordingBegun], frozen=True, tag="record now"):
    """Record from `before` seconds before now to `after` seconds after; None: as configured."""

    before: float | None = None
    after: float | None = None
    note: str = ""


class RecordingFetch(WaitingRequest[recordings.Recording], frozen=True, tag="recording fetch"):
    """Somebody takes the messages of a recording: it is recorded who."""

    id: str


class RecordingRead(WaitingRequest[recordings.Recording], frozen=True, tag="recording read"):
    """Somebody reads messages of a recording, of these topics (none: of all): it is recorded who."""

    id: str
    topics: list[str] = []


class RecordingOfMemory(WaitingRequest[recordings.Recording], frozen=True, tag="recording memory"):
    """What is in memory, to be read: from `since` to `until`, nanoseconds since the epoch (None: all, now).

    It is no recording that is kept: for ten minutes, or until somebody else asks, it can be fetched as one.
    """

    since: int | None = None
    until: int | None = None


class RecordingRemove(WaitingRequest[recordings.Recording], frozen=True, tag="recording remove"):
    """Remove a recording."""

    id: str


RecorderRequest = (
    RecordingsWanted | RecordingWanted | RecordNow | RecordingFetch | RecordingRead | RecordingOfMemory
    | RecordingRemove
)  # fmt: skip


class TokenAdd(AdminRequest[tokens.NewToken], frozen=True, tag="token add"):
    """Make a token that ends after `seconds`; the answer is the only place where its text ever stands."""

    name: str
    role: TokenRole
    seconds: float


class TokenList(AdminRequest[tokens.Tokens], frozen=True, tag="token list"):
    """All tokens that were made, without their secrets."""


class TokenRevoke(AdminRequest[tokens.Token], frozen=True, tag="token revoke"):
    """End a token now."""

    name: str


class HostAdd(WaitingRequest[hosts.KitParts], frozen=True, tag="host add"):
    """Enrol a host by a signing request (PKCS #10, PEM) for the key that it has, for `days`.

    `address`: the virtual address it shall have; None: the next free one.
    """

    name: str
    request: str
    days: float = 90
    address: str | None = None
    expected: int | None = None


class HostToken(WaitingRequest[hosts.EnrolmentToken], frozen=True, tag="host token"):
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


class HostEnrol(WaitingRequest[hosts.KitParts], frozen=True, tag="host enrol"):
    """The host itself, at the real address `peer`, brings its token and a signing request (PEM)."""

    token: str
    request: str
    peer: str


class HostRenew(WaitingRequest[hosts.KitParts], frozen=True, tag="host renew"):
    """A new certificate for an enrolled host; the one before is revoked."""

    name: str
    request: str
    days: float = 90
    expected: int | None = None


class HostRenewItself(WaitingRequest[hosts.NewCertificate], frozen=True, tag="host renew itself"):
    """A host asks through its tunnel, at its virtual address `peer`, for a certificate for a new key.

    `proof` is the signature of its present key over the bytes of `request`. The certificate before is good until
    `HostRenewed`.
    """

    name: str
    request: str
    proof: bytes
    peer: str


class HostRenewed(AdminRequest[hosts.Renewed], frozen=True, tag="host renewed"):
    """A host at its virtual address `peer` has put its new certificate in place: the one before ends now."""

    name: str
    peer: str


class HostList(AdminRequest[hosts.Hosts], frozen=True, tag="host list"):
    """All hosts that were enrolled or declared, with their tunnels."""


class HostEndpoint(AdminRequest[hosts.Endpoint], frozen=True, tag="host endpoint"):
    """At which address hosts reach the appliance, where nobody says it: `endpoint`, and `reason`: why that one."""


class HostKit(AdminRequest[hosts.KitParts], frozen=True, tag="host kit"):
    """What an enrolled host's kit is made of, without its private key."""

    name: str


class HostRevoke(AdminRequest[hosts.Revoked], frozen=True, tag="host revoke"):
    """Let a host in no more, and cut what it has, now."""

    name: str
    expected: int | None = None


class HostPorts(AdminRequest[hosts.PortsTold], frozen=True, tag="host ports"):
    """Somebody tried the ROS ports of a host from outside, at `checked` (seconds since the epoch; None: now).

    `name` is an enrolled or declared host's, or an address of a machine that nodes run on.
    """

    name: str
    state: Literal["closed", "open", "unknown"]
    open: list[int] = []
    checked: float | None = None
    expected: int | None = None


class HostsReload(AdminRequest[hosts.Reloaded], frozen=True, tag="hosts reload"):
    """Read `ipsec/hosts.yaml` again."""

    expected: int | None = None


class RevocationsWanted(AdminRequest[hosts.RevocationList], frozen=True, tag="host revocations"):
    """The authority's signed list of revoked certificates, in PEM."""


class AuthorityWanted(AdminRequest[hosts.AuthorityCertificate], frozen=True, tag="host authority"):
    """The authority's certificate, in PEM."""


class LogSealed(WaitingRequest[evidence.Sealed], frozen=True, tag="audit seal"):
    """Have all that was recorded sealed by a signed checkpoint, now."""


class EvidenceExported(WaitingRequest[evidence.Sealed], frozen=True, tag="evidence exported"):
    """Record that a bundle was made whose manifest has this hash, and have that sealed.

    It has so many `records`, from `since` until before `until` (nanoseconds since the epoch), and the `recording` of
    this id.
    """

    manifest: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
    since: int
    until: int
    records: int
    recording: str = ""


class ChallengeWanted(AdminRequest[tokens.Challenge], frozen=True, tag="challenge"):
    """A challenge, under which the next order over REST is signed."""


HostRequest = (
    HostAdd | HostToken | HostEnrol | HostRenew | HostRenewItself | HostRenewed | HostList | HostKit | HostRevoke
    | HostPorts | HostsReload | RevocationsWanted | AuthorityWanted | HostEndpoint
)  # fmt: skip
_Common = (
    StatusWanted | InventoryWanted | PolicyReload | PolicyRollback | PolicyConfirm | PolicyLoad | PolicyWanted
    | PolicyRevisions
    | RegistrationsWanted | GraphWanted | TopicLook | MetricsWanted | MonitorsWanted | MonitorRevisions
    | MonitorRevisionWanted | MonitorChange | TokenList | TokenRevoke | LogSealed | EvidenceExported
    | RecorderRequest | HostRequest
)  # fmt: skip
RestRequest = _Common | ChallengeWanted
AnyRequest = _Common | TokenAdd


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
