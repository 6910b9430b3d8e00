"""Define the feature sso, with a process of its own that speaks with the provider."""

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import Feature
from appliance.features.sso.quotas import ROWS
from appliance.features.sso.settings import Sso
from appliance.supervisor.role import RemoteReceiver, sender

ROLE = "sso"
_VERBS = "appliance.features.sso.verbs"


def _receiver(sso: Sso) -> RemoteReceiver | None:
    return None if sso.issuer is None else RemoteReceiver("single sign-on", "https", *sso.destination)


FEATURE = Feature(
    settings=Sso,
    roles=(
        sender(
            ROLE, "rosrv-sso", "sso", "appliance.features.sso.process:main", section=Sso, receiver=_receiver,
            ended_early=700,
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
