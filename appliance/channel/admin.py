"""The requests of operators' tools to the running appliance. Each request names the struct of its answer.

Only the owner of the state directory and root may use the admin socket, which carries one JSON document per line in
each direction. The docstring of a request with `@rest` is its description in the REST contract, unless the row has
`words`. A change is rejected if the revision in force is not `expected`.
"""

import functools
from typing import (
    Annotated,
    Generic,
    Literal,
    TypeVar,
    cast,
    get_args,
)

import msgspec

from appliance.channel import rest_bodies as bodies
from appliance.channel.answers import (
    graph_answers,
    inventory_answers,
    measures,
    monitor_answers,
    policy_answers,
    status,
    token_answers,
)
from appliance.channel.answers.field_docs import doc
from appliance.channel.answers.token_answers import TokenRole
from appliance.channel.rest_operation import Body, Operation, Versioned, parameter, rest, rows

A = TypeVar("A")
A_co = TypeVar("A_co", covariant=True)

POLICY = Versioned("policy", "/v1/policy", "The policy in force is not the one that If-Match names.")
MONITORS = Versioned(
    "monitors",
    "/v1/monitors",
    "The monitors were changed, switched or resumed since the ETag in If-Match was read.",
    seconds=40.0,  # RVMaster compiles first, then the relay
)

_WITHIN = ("confirm_within",)
_LOADED = (*_WITHIN, "force", "shadow", "hold")
_ROLLBACK = Body("Rollback", "The revision to return to, or null for the revision before the present one.")
_NO_MONITOR = {404: "There is no such monitor, or revision."}

Revision = Annotated[int, parameter("number of the revision", ge=1, le=bodies.LONGEST_REVISION, examples=[1])]
Confirm = Annotated[
    Annotated[float, msgspec.Meta(gt=0, le=86_400)] | None,
    parameter("seconds after which the change is rolled back automatically unless confirmed"),
]
Force = Annotated[bool, parameter("load even if this cuts a topic whose publisher has another type")]
Hold = Annotated[
    bool, parameter("load even if monitors then hold topics with traffic until they are resumed")
]
Shadow = Annotated[bool, parameter("load the specifications in shadow mode")]
OneMonitor = Annotated[
    str, parameter("name of the monitor", min_length=1, max_length=256, examples=["censor"])
]
SomeMonitors = Annotated[list[OneMonitor], parameter(name="name", min_length=1, max_length=1000)]


class AdminRequest(msgspec.Struct, Generic[A_co], frozen=True, tag_field="verb", forbid_unknown_fields=True):
    """A question or an order to the running appliance, which an `A` answers."""


class WaitingRequest(AdminRequest[A_co], Generic[A_co], frozen=True):
    """A request that waits for another process, such as charon, or for a topic's messages: others go past it.

    The worker of REST lets other requests go past every order, so only questions need this class, and orders that are
    refused rather than served in turn when many wait.
    """


def verb_of(request: AdminRequest[object]) -> str:
    return str(type(request).__struct_config__.tag)


@rest("viewer", "GET", "/v1/status", name="status", tag="status")
class StatusWanted(AdminRequest[status.Status], frozen=True, tag="status"):
    """The running appliance: processes, isolation, policy, graph, audit log."""


@rest("viewer", "GET", "/v1/inventory", name="inventory", tag="status")
class InventoryWanted(AdminRequest[inventory_answers.Inventory], frozen=True, tag="inventory"):
    """The running software: version, build, parts with their licences, and the kernel's features in use."""


@rest("operator", "POST", "/v1/policy/reload", _WITHIN, name="reload_policy", of=POLICY)
class PolicyReload(AdminRequest[policy_answers.Loaded], frozen=True, tag="policy reload"):
    """Read the policy file again."""

    confirm_within: Confirm = None
    expected: int | None = None


@rest("operator", "POST", "/v1/policy/rollback", name="roll_back_policy", body=_ROLLBACK, of=POLICY)
class PolicyRollback(AdminRequest[policy_answers.Loaded], frozen=True, tag="policy rollback"):
    """Bring a kept revision into force again, as a new one."""

    revision: bodies.Revision = None  # None: the one before the present
    expected: int | None = None


@rest("operator", "POST", "/v1/policy/confirm", name="confirm_policy", of=POLICY)
class PolicyConfirm(AdminRequest[policy_answers.PolicyConfirmed], frozen=True, tag="policy confirm"):
    """Keep a policy that was loaded with `confirm_within`."""

    expected: int | None = None


@rest(
    "admin", "POST", "/v1/policy", _WITHIN, name="load_policy", body=Body("PolicyText", "A new policy."),
    text="the policy", of=POLICY, dry_run="loading a policy",
)  # fmt: skip
class PolicyLoad(AdminRequest[policy_answers.Loaded], frozen=True, tag="policy load"):
    """Check, test and load a new text, decide all live rights again, and report. For admins.

    A text with an error changes nothing: the answer (422) has every finding with its line and column.
    """

    text: Annotated[str, doc("the whole text, as written", min_length=1, max_length=2 << 20)]
    note: bodies.RevisionNote = ""
    confirm_within: Confirm = None
    expected: int | None = None
    signature: bodies.Signature = ""


@rest("viewer")
class PolicyWanted(AdminRequest[policy_answers.PolicyKnown], frozen=True, tag="policy"):
    """The text of a revision (None: the one in force), with the test cases and addresses needed to judge it."""

    revision: int | None = None


@rest(
    "viewer", "GET", "/v1/policy/revisions/{revision}", name="policy_revision",
    problems={404: "There is no such revision."},
)  # fmt: skip
class PolicyRevisionWanted(AdminRequest[policy_answers.RevisionText], frozen=True, tag="policy revision"):
    """A kept revision with its text."""

    revision: Revision


@rest("viewer", "GET", "/v1/policy/revisions", name="policy_revisions")
class PolicyRevisions(AdminRequest[policy_answers.PolicyRevisionList], frozen=True, tag="policy revisions"):
    """The kept revisions, newest first."""


@rest("viewer")
class RegistrationsWanted(AdminRequest[graph_answers.Registrations], frozen=True, tag="registrations"):
    """The live registrations that a change of the policy may end."""


@rest("viewer", "GET", "/v1/graph", name="graph")
class GraphWanted(AdminRequest[graph_answers.Graph], frozen=True, tag="graph"):
    """Nodes, topics and services, whether the appliance relays them, and rates."""


@rest(None)
class MetricsWanted(AdminRequest[measures.Measures], frozen=True, tag="metrics"):
    """The status, and everything that control counts."""


@rest("viewer", "GET", "/v1/monitors", ("texts",), name="monitors", of=MONITORS)
class MonitorsWanted(AdminRequest[monitor_answers.Monitors], frozen=True, tag="monitors"):
    """All monitors with state and counters, and whether they are equal to the files of the folder."""

    texts: Annotated[bool, parameter("include the texts of the specifications")] = False


@rest(
    "admin", "POST", "/v1/monitors", _LOADED, name="load_monitors", of=MONITORS,
    body=Body("NewSpecifications", "Specifications to add; they replace those in files of the same name."),
    dry_run="loading specifications",
)  # fmt: skip
class MonitorLoad(AdminRequest[monitor_answers.Replaced], frozen=True, tag="monitor load"):
    """Compile and load specifications; those in files of the same name are replaced, in one swap. For admins.

    A text with an error changes nothing: the answer (422) has every finding with its line and column.
    """

    files: Annotated[
        dict[bodies.FileName, bodies.FileText],
        doc("texts by the name of the file", min_length=1, max_length=1000),
    ]
    definitions: bodies.Definitions = {}
    note: bodies.RevisionNote = ""
    expected: str | None = None
    confirm_within: Confirm = None
    signatures: bodies.Signatures = {}
    force: Force = False
    shadow: Shadow = False
    hold: Hold = False
    given: Annotated[
        dict[bodies.MonitorName, bodies.GivenOfMonitor],
        doc("constants and topics that are given to monitors, by monitor and name", max_length=1000),
    ] = {}


@rest(
    "admin", "PUT", "/v1/monitors/{name}", _LOADED, name="replace_monitor",
    body=Body("NewText", "The new text of the file that contains a monitor."),
    text="the specification", of=MONITORS, problems=_NO_MONITOR,
    dry_run="loading specifications",
)  # fmt: skip
class MonitorReplace(AdminRequest[monitor_answers.Replaced], frozen=True, tag="monitor replace"):
    """Load a new text in place of the file that defines this monitor (or of the file of this name). For admins;
    operators may only make a dry run.
    """

    name: OneMonitor
    text: bodies.WholeText
    definitions: bodies.Definitions = {}
    note: bodies.RevisionNote = ""
    expected: str | None = None
    confirm_within: Confirm = None
    signature: bodies.Signature = ""
    signatures: Annotated[bodies.Signatures, doc("signatures of the definitions")] = {}
    force: Force = False
    shadow: Shadow = False
    hold: Hold = False
    given: Annotated[
        dict[bodies.MonitorName, bodies.GivenValue],
        doc("constants and topics that are given to this monitor", max_length=100),
    ] = {}


@rest("operator", of=MONITORS)
class MonitorTry(WaitingRequest[monitor_answers.Replaced], frozen=True, tag="monitor try"):
    """Report what an order would do; nothing changes."""

    order: MonitorLoad | MonitorReplace


@rest(
    "operator", "POST", "/v1/monitors/reload", ("prune", *_LOADED), name="reload_monitors", of=MONITORS,
    admin_with={"prune": "removing files that the folder does not have"},
)  # fmt: skip
class MonitorReload(AdminRequest[monitor_answers.Replaced], frozen=True, tag="monitor reload"):
    """Load the files of the folder. Specifications that the folder lacks stay in force unless an admin sets `prune`."""

    expected: str | None = None
    prune: Annotated[bool, parameter("also remove files that the folder does not have")] = False
    confirm_within: Confirm = None
    force: Force = False
    shadow: Shadow = False
    hold: Hold = False


@rest(
    "admin", "DELETE", "/v1/monitors", ("names", "confirm_within"), name="remove_monitors",
    words="The same for several at once.", of=MONITORS, problems=_NO_MONITOR,
)  # fmt: skip
@rest(
    "admin", "DELETE", "/v1/monitors/{name}", _WITHIN, name="remove_monitor", of=MONITORS, problems=_NO_MONITOR,

)  # fmt: skip
class MonitorRemove(AdminRequest[monitor_answers.Replaced], frozen=True, tag="monitor remove"):
    """Remove the file of a monitor (or the file of this name); rejected if other files use its variables."""

    names: SomeMonitors
    expected: str | None = None
    confirm_within: Confirm = None


@rest(
    "admin", "POST", "/v1/monitors/rollback", name="roll_back_monitors", body=_ROLLBACK, of=MONITORS,

)  # fmt: skip
class MonitorRollback(AdminRequest[monitor_answers.Replaced], frozen=True, tag="monitor rollback"):
    """Bring a kept revision into force again, as a new one; monitors are enabled and disabled as they were."""

    revision: bodies.Revision = None  # None: the one before the present
    expected: str | None = None


@rest("operator", "POST", "/v1/monitors/confirm", name="confirm_monitors", of=MONITORS)
class MonitorConfirm(AdminRequest[monitor_answers.MonitorsConfirmed], frozen=True, tag="monitor confirm"):
    """Keep specifications that were loaded with `confirm_within`."""

    expected: str | None = None


@rest("viewer", "GET", "/v1/monitors/revisions", name="monitor_revisions")
class MonitorRevisions(
    AdminRequest[monitor_answers.MonitorRevisionList], frozen=True, tag="monitor revisions"
):
    """The kept revisions of the specifications, newest first."""


@rest("viewer", "GET", "/v1/monitors/revisions/{revision}", name="monitor_revision", problems=_NO_MONITOR)
class MonitorRevisionWanted(AdminRequest[monitor_answers.RevisionTexts], frozen=True, tag="monitor revision"):
    """A kept revision with its texts."""

    revision: Revision


_SWITCH = """
Enable or disable a monitor, put it into shadow mode (`{"shadow": true}`) or from there into force (`false`).

`{"enabled": false, "for_seconds": 600}` disables it for ten minutes. `{"held": false}` resumes the topics that it
holds.
"""
_ONE = "/v1/monitors/{name}"
_SEVERAL = "/v1/monitors"


@rest(
    "operator", "PATCH", _SEVERAL, name="switch_monitors", words="The same for several at once.",
    body=bodies.SwitchMany, of=MONITORS, problems=_NO_MONITOR,
)  # fmt: skip
@rest(
    "operator", "PATCH", _ONE, name="switch_monitor", words=_SWITCH, body=bodies.Switch, of=MONITORS,
    problems=_NO_MONITOR,
)  # fmt: skip
class MonitorSwitch(AdminRequest[monitor_answers.Switched], frozen=True, tag="monitor switch"):
    """Enable or disable the events of these monitors: for `for_seconds`, or (None) until they are enabled again."""

    names: SomeMonitors
    enabled: bool
    expected: str | None = None
    for_seconds: bodies.SwitchSeconds = None


@rest("operator", "PATCH", _SEVERAL, ("force", "confirm_within"), of=MONITORS)
@rest("operator", "PATCH", _ONE, ("force", "confirm_within"), of=MONITORS)
class MonitorShadow(AdminRequest[monitor_answers.Switched], frozen=True, tag="monitor shadow"):
    """Put these monitors into shadow mode, or (false) bring those in shadow mode into force.

    `force` has the same meaning as for a load. With `confirm_within` the monitors return to shadow mode
    unless confirmed.
    """

    names: SomeMonitors
    shadow: bool
    expected: str | None = None
    force: Force = False
    confirm_within: Confirm = None


@rest(
    "operator", "PATCH", "/v1/monitors/{name}/given", name="set_monitor", of=MONITORS,
    body=Body("GivenValues", "New values of constants that are given to a monitor, by name."),
    problems=_NO_MONITOR,
)  # fmt: skip
class MonitorGive(AdminRequest[monitor_answers.GivenSet], frozen=True, tag="monitor set"):
    """Set constants that are given to a monitor, within their ranges; the monitor keeps its state and text."""

    name: OneMonitor
    values: Annotated[bodies.GivenOfMonitor, doc("in the units of the text, within the ranges of the text")]
    expected: str | None = None


@rest("operator", "PATCH", _SEVERAL, says={"held": False}, of=MONITORS)
@rest("operator", "PATCH", _ONE, says={"held": False}, of=MONITORS)
class MonitorResume(AdminRequest[monitor_answers.Switched], frozen=True, tag="monitor resume"):
    """Release the topics that these monitors hold."""

    names: SomeMonitors
    expected: str | None = None


@rest("operator", "GET", "/v1/monitors/{name}/values", name="monitor_values", problems=_NO_MONITOR)
class MonitorValuesWanted(WaitingRequest[monitor_answers.MonitorReadout], frozen=True, tag="monitor values"):
    """The present variables of a monitor, such as the position that a fence has. The query is recorded.

    Variables of slices are not among them.
    """

    name: OneMonitor


class TokenAdd(AdminRequest[token_answers.NewToken], frozen=True, tag="token add"):
    """Make a token that ends after `seconds`; its text is in the answer and nowhere else."""

    name: str
    role: TokenRole
    seconds: float


class TokenRotate(AdminRequest[token_answers.RotatedToken], frozen=True, tag="token rotate"):
    """Replace the valid tokens of a name by a new one of the same role; its text is in the answer and nowhere else.

    The new token ends after `seconds` (None: as long after its start as the earlier one), the earlier ones after
    `grace` seconds, but not later than before.
    """

    name: str
    seconds: float | None = None
    grace: float = 0.0


@rest("admin", "GET", "/v1/tokens", name="tokens")
class TokenList(AdminRequest[token_answers.Tokens], frozen=True, tag="token list"):
    """All access tokens that were made, without their secrets. For admins."""


@rest(
    "admin", "DELETE", "/v1/tokens/{name}", name="revoke_token",
    problems={422: "There is no valid token of this name."},
)  # fmt: skip
class TokenRevoke(AdminRequest[token_answers.Token], frozen=True, tag="token revoke"):
    """End a token: it is then answered with 401, and open streams of its holder end. For admins."""

    name: Annotated[str, parameter(min_length=1, max_length=80, examples=["shift"])]


@rest("viewer", "GET", "/v1/challenge", name="challenge", tag="status")
class ChallengeWanted(AdminRequest[token_answers.Challenge], frozen=True, tag="challenge"):
    """A challenge: each order that changes something is signed with one, and each is accepted once."""


CORE_REQUESTS: tuple[type[AdminRequest[object]], ...] = (TokenAdd, TokenRotate, *rows())
"""The requests of the core; `channel/operations.py` adds those of features."""


def operation_of(request: AdminRequest[object]) -> Operation | None:
    given = msgspec.structs.asdict(request)
    for operation in rows().get(type(request), ()):
        if all(given[name] == value for name, value in operation.fixed.items()):
            return operation
    return None


Trouble = Literal["", "request", "refused", "conflict", "unknown", "forbidden", "busy", "failed", "standby"]


class AdminAnswer(msgspec.Struct, Generic[A_co], frozen=True):
    """The answer: `ok` with a body, or an error with its findings.

    `trouble` is the kind of an error: `request` (makes no sense), `refused` (the policy or name given is wrong),
    `conflict` (the revision in force is not the expected one), `unknown` (does not exist), `forbidden` (not for this
    client), `busy` (too much at once), `failed` (the appliance cannot do it now), `standby` (only the active
    appliance can do it).
    """

    ok: bool
    body: A_co | None = None
    error: str = ""
    findings: list[str] = []
    trouble: Trouble = ""
    tag: str = ""
    active: str = ""

    def unwrap(self) -> A_co:
        assert self.body is not None  # noqa: S101  it has one
        return self.body


encode = msgspec.json.Encoder().encode


@functools.cache
def _decoder(kind: type[AdminRequest[A]]) -> msgspec.json.Decoder[AdminAnswer[A]]:
    return msgspec.json.Decoder(AdminAnswer[answer_to(kind)])  # type: ignore[misc]  # known when it runs only


def answer_to(kind: type[AdminRequest[A]]) -> type[A]:
    (answer,) = get_args(kind.__orig_bases__[0])  # type: ignore[attr-defined]  # what `typing` keeps of its bases
    return cast(type[A], answer)


def decode(document: bytes, request: AdminRequest[A]) -> AdminAnswer[A]:
    return _decoder(type(request)).decode(document)
