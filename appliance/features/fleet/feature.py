"""Define the feature fleet, with a process for each direction."""

from functools import partial

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import Feature
from appliance.features.fleet.settings import POLLER, PUSHER, Fleet
from appliance.supervisor.role import RemoteReceiver, sender

_VERBS = "appliance.features.fleet.verbs"


def _receiver(client: str, fleet: Fleet) -> RemoteReceiver | None:
    return None if fleet.collector is None else RemoteReceiver(client, "https", *fleet.destination)


FEATURE = Feature(
    settings=Fleet,
    roles=(
        sender(
            PUSHER, "rosrv-fleet", "fleet", "appliance.features.fleet.segment_process:main", section=Fleet,
            receiver=partial(_receiver, "segments"), configured=lambda fleet: fleet.receipt_key is not None,
            reads_log=True, ended_early=600, stands_by=True,
        ),
        sender(
            POLLER, "rosrv-bundles", "bundles", "appliance.features.fleet.process:main", section=Fleet,
            receiver=partial(_receiver, "bundles"), configured=lambda fleet: fleet.bundles.root is not None,
            ended_early=600,
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
