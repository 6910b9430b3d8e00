"""Define the feature sso, with a process of its own that speaks with the provider."""

from appliance.cli.verb_table import Group, Verb
from appliance.configuration.sections import Sections
from appliance.features.feature import Feature
from appliance.features.sso.quotas import ROWS
from appliance.features.sso.settings import Sso
from appliance.supervisor.role import Facts, RemoteReceiver, Role
from appliance.supervisor.sandbox.folders import folders_of
from appliance.supervisor.sandbox.sandbox_plan import ROUTES, SandboxPlan

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


FEATURE = Feature(
    settings=Sso,
    roles=(
        Role(
            ROLE, "rosrv-sso", "sso", "appliance.features.sso.process:main",
            path=lambda facts: facts.config, links=("control",), ended_early=700, nice=10, after="control",
            dispensable=True, inputs=lambda facts: facts.sections.of(Sso).files, sandbox=_sandbox,
            configured=_configured, receiver=_receiver,
        ),
    ),
    verbs={
        "sso": Group(
            "List and end the sessions of people who signed in at the single sign-on provider.",
            {"list": Verb(f"{_VERBS}:list_sessions"), "end": Verb(f"{_VERBS}:end")},
            after="token",
        )
    },
    quotas=ROWS,
)  # fmt: skip
