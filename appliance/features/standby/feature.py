"""Define the feature standby (docs/standby.md)."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import ConsolePart, Feature
from appliance.features.standby.membership import FILE, FOLDER, LEASE_FILE, LEASE_NICE, LEFT_FILE
from appliance.supervisor.role import Role
from appliance.supervisor.sandbox.sandbox_plan import NETWORK, SandboxPlan

if TYPE_CHECKING:
    from appliance.channel.admin import AdminRequest
    from appliance.supervisor.service_gate import Pairing

_PLACE = "appliance.features.standby."


def _pairing(state: Path) -> "Pairing | None":
    from appliance.features.standby.pairing import pairing_in  # noqa: PLC0415  only the supervisor needs it

    return pairing_in(state)


def _operations() -> "tuple[type[AdminRequest[Any]], ...]":
    from appliance.features.standby.standby_requests import REQUESTS  # noqa: PLC0415  few processes need it

    return REQUESTS


STANDBY = Feature(
    "standby",
    roles=(
        Role(
            "lease", "rosrv-lease", "lease", f"{_PLACE}process:main",
            path=lambda facts: facts.run(LEASE_FILE), links=("control",), outlives_takeover=True, nice=LEASE_NICE,
            paired=True, sandbox=lambda _facts: SandboxPlan(allowlist=True, families=NETWORK, binds=None),
        ),
    ),
    operations=_operations,
    verbs={
        "standby": Group(
            "Run two appliances, of which one stands by to take over.",
            {
                "join": Verb(f"{_PLACE}membership_verbs:join"),
                "leave": Verb(f"{_PLACE}membership_verbs:leave"),
                "repair": Verb(f"{_PLACE}membership_verbs:repair"),
                "status": Verb(f"{_PLACE}live_verbs:status"),
                "promote": Verb(f"{_PLACE}live_verbs:promote"),
            },
            after="host",
        ),
    },
    console=(
        ConsolePart("banner", "pair.js", "PairBanner"),
        ConsolePart("now", "pair.js", "PairNow"),
        ConsolePart("standby", "page.js", "StandbyPage"),
    ),
    pairing=_pairing,
    state_files=(f"{FOLDER}/{FILE}", f"{FOLDER}/{LEFT_FILE}"),
    may_start=f"{_PLACE}start_gate:StandbyGate",
)  # fmt: skip
