"""Define the feature fleet, with a process for each direction."""

from appliance.cli.verb_table import Group, Verb
from appliance.configuration.sections import Sections
from appliance.features.feature import Feature
from appliance.features.fleet.settings import POLLER, PUSHER, Fleet
from appliance.supervisor.role import Facts, RemoteReceiver, Role
from appliance.supervisor.sandbox.folders import folders_of
from appliance.supervisor.sandbox.sandbox_plan import ROUTES, SandboxPlan

_VERBS = "appliance.features.fleet.verbs"


def _receiver(client: str, sections: Sections) -> RemoteReceiver | None:
    wanted = sections.of(Fleet)
    return None if wanted.collector is None else RemoteReceiver(client, "https", *wanted.destination)


def _sandbox(facts: Facts, *, log: bool) -> SandboxPlan:
    wanted = facts.sections.of(Fleet)
    return SandboxPlan(
        allowlist=True,
        families=ROUTES,
        reads=(*([str(facts.part("control"))] if log else []), *folders_of(*wanted.files)),
        connects=None if wanted.collector is None else (wanted.destination[1],),
    )


FEATURE = Feature(
    settings=Fleet,
    roles=(
        Role(
            PUSHER, "rosrv-fleet", "fleet", "appliance.features.fleet.segment_process:main",
            path=lambda facts: facts.config, links=("control",), ended_early=600, nice=10, after="control",
            dispensable=True, group="rosrv-api", stands_by=True, inputs=lambda facts: facts.sections.of(Fleet).files,
            sandbox=lambda facts: _sandbox(facts, log=True),
            configured=lambda sections: sections.of(Fleet).receipt_key is not None,
            receiver=lambda sections: _receiver("segments", sections),
        ),
        Role(
            POLLER, "rosrv-bundles", "bundles", "appliance.features.fleet.process:main",
            path=lambda facts: facts.config, links=("control",), ended_early=600, nice=10, after="control",
            dispensable=True, inputs=lambda facts: facts.sections.of(Fleet).files,
            sandbox=lambda facts: _sandbox(facts, log=False),
            configured=lambda sections: sections.of(Fleet).bundles.root is not None,
            receiver=lambda sections: _receiver("bundles", sections),
        ),
    ),
    verbs={
        "fleet": Group(
            "Push the audit log to the collector of many robots, and take its bundles: policy, specifications, hosts.",
            {
                "join": Verb(f"{_VERBS}:join"),
                "leave": Verb(f"{_VERBS}:leave"),
                "take": Verb("appliance.features.fleet.take_verb:take"),
            },
            after="standby",
        )
    },
)  # fmt: skip
