"""Define the feature sso, with a process of its own that speaks with the provider."""

from typing import TYPE_CHECKING, Any

from appliance.cli.verb_table import Group, Verb
from appliance.configuration.sections import Sections
from appliance.features.feature import Feature, FeaturePart, OperatorContext
from appliance.features.sso.quotas import ROWS
from appliance.features.sso.settings import Sso
from appliance.supervisor.role import Facts, RemoteReceiver, Role
from appliance.supervisor.sandbox.folders import folders_of
from appliance.supervisor.sandbox.sandbox_plan import ROUTES, SandboxPlan

if TYPE_CHECKING:
    from appliance.channel.admin import AdminRequest

ROLE = "sso"
_VERBS = "appliance.features.sso.verbs"


def _configured(sections: Sections) -> bool:
    return sections.of(Sso).issuer is not None


def _receiver(sections: Sections) -> RemoteReceiver | None:
    if not _configured(sections):
        return None
    return RemoteReceiver("single sign-on", "https", *sections.of(Sso).destination)


def _sandbox(facts: Facts) -> SandboxPlan:
    wanted = facts.sections.of(Sso)
    return SandboxPlan(
        allowlist=True,
        families=ROUTES,
        reads=folders_of(*wanted.files),
        connects=(wanted.destination[1],) if wanted.issuer is not None else None,
    )


def _operations() -> "tuple[type[AdminRequest[Any]], ...]":
    from appliance.features.sso import sso_requests as requests  # noqa: PLC0415  only processes with requests need it

    return (
        requests.SignOnBegin,
        requests.SignOnComplete,
        requests.SessionsWanted,
        requests.SignOut,
        requests.SessionsEnd,
    )


def _operate(context: OperatorContext) -> FeaturePart:
    from appliance.control.operators.request_method import RequestMethod  # noqa: PLC0415  only control needs it
    from appliance.features.sso import sso_requests as requests  # noqa: PLC0415  as above
    from appliance.features.sso.link import SsoLink  # noqa: PLC0415  as above
    from appliance.features.sso.orders import SsoOrders  # noqa: PLC0415  as above

    configured = _configured(context.core.sections)
    orders = SsoOrders(context.core.trail, context.ends, context.tokens_changed, configured=configured)
    return FeaturePart(
        {ROLE: (orders.link, SsoLink)},
        methods=(
            RequestMethod(requests.SignOnBegin, orders.begin, order=False),
            RequestMethod(requests.SignOnComplete, orders.complete),
            RequestMethod(requests.SessionsWanted, orders.listed, order=False),
            RequestMethod(requests.SignOut, orders.sign_out, who=True, full_disk=True),
            RequestMethod(requests.SessionsEnd, orders.end, who=True, full_disk=True),
        ),
        longest={ROLE: 1 << 16},
        sessions=orders.sessions if configured else None,
    )


def _page(sections: Sections) -> dict[str, str]:
    return {"sign-on": sections.of(Sso).name} if _configured(sections) else {}


SSO = Feature(
    "sso",
    settings=Sso,
    roles=(
        Role(
            ROLE, "rosrv-sso", "sso", "appliance.features.sso.process:main",
            path=lambda facts: facts.config, links=("control",), ended_early=700, nice=10, after="control",
            dispensable=True, inputs=lambda facts: facts.sections.of(Sso).files, sandbox=_sandbox,
            configured=_configured, receiver=_receiver,
        ),
    ),
    operations=_operations,
    routes="appliance.features.sso.routes:routes",
    without_token=("/v1/sso/begin", "/v1/sso/complete"),
    page=_page,
    verbs={
        "sso": Group(
            "Sessions of people who signed in at the provider.",
            {"list": Verb(f"{_VERBS}:list_sessions"), "end": Verb(f"{_VERBS}:end")},
            after="token",
        )
    },
    quotas=ROWS,
    operate=_operate,
)  # fmt: skip
