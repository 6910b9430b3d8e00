"""List the requests of the core and of all features: what the admin socket and REST accept."""

from typing import TYPE_CHECKING, Union

from appliance.channel.admin import CORE_REQUESTS, AdminRequest, ChallengeWanted
from appliance.channel.rest_operation import rows
from appliance.features.table import members

REQUESTS = (
    *CORE_REQUESTS,
    *(request for requests in members("requests", "REQUESTS") for request in requests),
)
OPERATIONS = tuple(operation for request in REQUESTS for operation in rows().get(request, ()))
CHANGES = frozenset(operation.request for operation in OPERATIONS if operation.is_change)
"""The changes in the name of a token; for each, control requires the client's HTTP request."""

ORDERS = CHANGES | {operation.request for operation in OPERATIONS if operation.changes}
"""All changes over REST, in the name of a token or of a host."""

if TYPE_CHECKING:
    RestRequest = AdminRequest[object]
    AnyRequest = AdminRequest[object]
else:
    RestRequest = Union[tuple(operation.request for operation in OPERATIONS)]  # noqa: UP007  of any number
    AnyRequest = Union[tuple(request for request in REQUESTS if request is not ChallengeWanted)]  # noqa: UP007  as above


def request_named(verb: str) -> type[AdminRequest[object]] | None:
    return next((request for request in REQUESTS if request.__struct_config__.tag == verb), None)
