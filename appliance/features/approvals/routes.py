"""Answer REST about approvals: viewers read no contents of messages, so not the arguments of a call either."""

import msgspec

from appliance.api.front.route_roles import reads_contents
from appliance.api.front.services import Services
from appliance.api.routes.operation_routes import Answer, AnsweringRoutes, OperationCall
from appliance.features.approvals.requests import WITHHELD, Approvals, ApprovalsWanted


async def _listed(call: OperationCall[ApprovalsWanted]) -> Approvals:
    found = await call.ask(call.order)
    if reads_contents(call.bearer):
        return found
    shown = [
        msgspec.structs.replace(one, arguments="", sha256=one.sha256 and WITHHELD) for one in found.approvals
    ]
    return Approvals(shown)


def routes(_services: Services) -> AnsweringRoutes:
    return AnsweringRoutes({"approvals": Answer(_listed)})
