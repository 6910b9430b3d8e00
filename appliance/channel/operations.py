"""The operations of REST: which HTTP request asks what, and the least role that may.

One row an operation. The command line makes its calls from it, and control derives from it once more what a client has
signed and who may ask it; a test holds the api's routes against it.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import msgspec

from appliance.channel import admin
from appliance.channel.admin import AdminRequest
from appliance.channel.answers.tokens import TokenRole

PARAMETERS = {"names": "name", "topics": "topic"}
"""What a field is called in a query, where it may stand there several times."""


class Operation(NamedTuple):
    """How one thing is asked; `role` None: without a token. Without a path the api asks it to answer something else.

    A field of the request stands in the path (of a list: the only element), in the query, in `If-Match` (`expected`),
    or else in the body, under its name. `says` is what the body has besides; `fixed` are fields that the operation
    stands for. Both tell the operations of one path apart: the first that fits is meant.
    """

    request: type[AdminRequest[Any]]
    role: TokenRole | None
    method: str = ""
    path: str = ""
    query: tuple[str, ...] = ()
    says: Mapping[str, Any] = {}
    fixed: Mapping[str, Any] = {}

    def body(self) -> list[msgspec.structs.FieldInfo]:
        """The fields that the body has."""
        elsewhere = {"expected", *self.query, *self.fixed}
        fields = msgspec.structs.fields(self.request)
        return [
            field for field in fields if field.name not in elsewhere and f"{{{field.name}}}" not in self.path
        ]


_WITHIN = ("confirm_within",)
OPERATIONS = (
    Operation(admin.StatusWanted, "viewer", "GET", "/v1/status"),
    Operation(admin.InventoryWanted, "viewer", "GET", "/v1/inventory"),
    Operation(admin.GraphWanted, "viewer", "GET", "/v1/graph"),
    Operation(
        admin.TopicLook, "operator", "GET", "/v1/messages", ("topic", "messages", "seconds", "latched")
    ),
    Operation(admin.MetricsWanted, None),
    Operation(admin.ChallengeWanted, "viewer", "GET", "/v1/challenge"),
    Operation(admin.RegistrationsWanted, "viewer"),
    Operation(admin.PolicyWanted, "viewer"),
    Operation(admin.PolicyRevisions, "viewer", "GET", "/v1/policy/revisions"),
    Operation(admin.PolicyLoad, "admin", "POST", "/v1/policy", _WITHIN),
    Operation(admin.PolicyReload, "operator", "POST", "/v1/policy/reload", _WITHIN),
    Operation(admin.PolicyRollback, "operator", "POST", "/v1/policy/rollback"),
    Operation(admin.PolicyConfirm, "operator", "POST", "/v1/policy/confirm"),
    Operation(admin.MonitorsWanted, "viewer", "GET", "/v1/monitors", ("texts",)),
    Operation(admin.MonitorRevisions, "viewer", "GET", "/v1/monitors/revisions"),
    Operation(admin.MonitorRevisionWanted, "viewer", "GET", "/v1/monitors/revisions/{revision}"),
    Operation(admin.MonitorLoad, "admin", "POST", "/v1/monitors", _WITHIN),
    Operation(admin.MonitorReplace, "admin", "PUT", "/v1/monitors/{name}", _WITHIN),
    Operation(admin.MonitorReload, "operator", "POST", "/v1/monitors/reload", ("prune", *_WITHIN)),
    Operation(admin.MonitorRollback, "admin", "POST", "/v1/monitors/rollback"),
    Operation(admin.MonitorConfirm, "operator", "POST", "/v1/monitors/confirm"),
    Operation(admin.MonitorRemove, "admin", "DELETE", "/v1/monitors", ("names", *_WITHIN)),
    Operation(admin.MonitorRemove, "admin", "DELETE", "/v1/monitors/{names}", _WITHIN),
    Operation(admin.MonitorSwitch, "operator", "PATCH", "/v1/monitors"),
    Operation(admin.MonitorSwitch, "operator", "PATCH", "/v1/monitors/{names}"),
    Operation(admin.MonitorTrial, "operator", "PATCH", "/v1/monitors"),
    Operation(admin.MonitorTrial, "operator", "PATCH", "/v1/monitors/{names}"),
    Operation(admin.MonitorResume, "operator", "PATCH", "/v1/monitors", says={"held": False}),
    Operation(admin.MonitorResume, "operator", "PATCH", "/v1/monitors/{names}", says={"held": False}),
    # Whoever exports evidence asks these; whom the api lets do so is said at its routes.
    Operation(admin.LogSealed, "viewer"),
    Operation(admin.EvidenceExported, "viewer"),
    Operation(admin.RecordingsWanted, "viewer", "GET", "/v1/recordings"),
    Operation(admin.RecordNow, "operator", "POST", "/v1/recordings"),
    Operation(admin.RecordingWanted, "viewer", "GET", "/v1/recordings/{id}"),
    Operation(admin.RecordingFetch, "investigator", "GET", "/v1/recordings/{id}/bag"),
    Operation(admin.RecordingRead, "investigator", "GET", "/v1/recordings/{id}/messages", ("topics",)),
    Operation(admin.RecordingOfMemory, "investigator", "POST", "/v1/recordings/memory"),
    Operation(admin.RecordingRemove, "admin", "DELETE", "/v1/recordings/{id}"),
    Operation(admin.TokenList, "admin", "GET", "/v1/tokens"),
    Operation(admin.TokenRevoke, "admin", "DELETE", "/v1/tokens/{name}"),
    Operation(admin.HostList, "viewer", "GET", "/v1/hosts"),
    Operation(admin.HostEndpoint, "viewer"),
    Operation(admin.HostKit, "operator"),
    Operation(admin.HostToken, "admin", "POST", "/v1/hosts", says={"how": "token"}, fixed={"new": True}),
    Operation(admin.HostAdd, "admin", "POST", "/v1/hosts", says={"how": "kit"}),
    Operation(admin.HostToken, "admin", "POST", "/v1/hosts/{name}/token", fixed={"new": False}),
    Operation(admin.HostRenew, "admin", "POST", "/v1/hosts/{name}/kit"),
    Operation(admin.HostPorts, "operator", "PUT", "/v1/hosts/{name}/ports"),
    Operation(admin.HostRevoke, "admin", "DELETE", "/v1/hosts/{name}"),
    Operation(admin.HostsReload, "operator", "POST", "/v1/hosts/reload"),
    # A host asks these itself, with its one-time token or its key; the last two are public.
    Operation(admin.HostEnrol, None),
    Operation(admin.HostRenewItself, None),
    Operation(admin.HostRenewed, None),
    Operation(admin.RevocationsWanted, None),
    Operation(admin.AuthorityWanted, None),
)

CHANGES = frozenset(
    operation.request for operation in OPERATIONS if operation.path and operation.method != "GET"
)
"""What changes something in the name of a token: control makes it only with the request that asked for it."""


def operation_of(request: AdminRequest[Any]) -> Operation | None:
    """How a request is asked; None: not over REST."""
    for operation in OPERATIONS:
        if operation.request is type(request) and all(
            getattr(request, name) == operation.fixed[name] for name in operation.fixed
        ):
            return operation
    return None
