"""Define the feature standby (docs/standby.md)."""

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import ConsolePart, Feature
from appliance.features.standby.membership import LEASE_FILE, LEASE_NICE
from appliance.supervisor.role import Role
from appliance.supervisor.sandbox.sandbox_plan import NETWORK, SandboxPlan

_PLACE = "appliance.features.standby."


FEATURE = Feature(
    roles=(
        Role(
            "lease", "rosrv-lease", "lease", f"{_PLACE}process:main",
            path=lambda facts: facts.run(LEASE_FILE), links=("control",), outlives_takeover=True, nice=LEASE_NICE,
            paired=True, sandbox=lambda _facts: SandboxPlan(allowlist=True, families=NETWORK, binds=None),
        ),
    ),
    verbs={
        "standby": Group(
            "Run two appliances, of which one stands by to take over.",
            {
                "join": Verb(f"{_PLACE}membership_verbs:join"),
                "leave": Verb(f"{_PLACE}membership_verbs:leave"),
                "repair": Verb(f"{_PLACE}membership_verbs:repair"),
                "status": Verb(f"{_PLACE}live_verbs:status"),
                "switch": Verb(f"{_PLACE}live_verbs:switch"),
            },
            after="host",
        ),
    },
    console=(
        ConsolePart("banner", "pair.js", "PairBanner"),
        ConsolePart("situation", "pair.js", "Ready", order=4),
        ConsolePart("now", "pair.js", "PairNow"),
        ConsolePart("standby", "page.js", "StandbyPage"),
    ),
)  # fmt: skip
