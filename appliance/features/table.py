"""List the features of the product. The core imports only this module and `feature.py` of the folder `features`.

To remove a feature, remove its folder, and its imports and rows here and in `views.py`.
"""

import pkgutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from appliance.cli.verb_table import Group, Verb
from appliance.configuration.sections import Sections
from appliance.features.adopt.feature import ADOPT
from appliance.features.alarms.feature import ALARMS
from appliance.features.approvals.feature import APPROVALS
from appliance.features.audit_tools.feature import AUDIT_TOOLS
from appliance.features.authority.feature import AUTHORITY
from appliance.features.backup.feature import BACKUP
from appliance.features.blocks.feature import BLOCKS
from appliance.features.demo.feature import DEMO
from appliance.features.doors.feature import DOORS
from appliance.features.evidence.feature import EVIDENCE
from appliance.features.feature import Feature
from appliance.features.fleet.feature import FLEET
from appliance.features.guards.feature import GUARDS
from appliance.features.limits.feature import LIMITS
from appliance.features.live.feature import LIVE
from appliance.features.logbook.feature import LOGBOOK
from appliance.features.metrics.feature import METRICS
from appliance.features.monitor_tools.feature import MONITOR_TOOLS
from appliance.features.policy_tools.feature import POLICY_TOOLS
from appliance.features.recorder.feature import RECORDER
from appliance.features.selftest.feature import SELFTEST
from appliance.features.sign.feature import SIGN
from appliance.features.sso.feature import SSO
from appliance.features.standby.feature import STANDBY
from appliance.features.survey.feature import SURVEY
from appliance.features.syslog.feature import SYSLOG
from appliance.features.tokens.feature import TOKENS
from appliance.features.topics.feature import TOPICS
from appliance.features.tunnels.feature import TUNNELS
from appliance.supervisor.role import SharedMemory

if TYPE_CHECKING:
    from appliance.supervisor.machine_work import MachineWork
    from appliance.supervisor.service_gate import Pairing

FEATURES: tuple[Feature, ...] = (
    AUDIT_TOOLS,
    POLICY_TOOLS,
    MONITOR_TOOLS,
    ALARMS,
    LIMITS,
    BLOCKS,
    SIGN,
    TOPICS,
    TUNNELS,
    SYSLOG,
    EVIDENCE,
    RECORDER,
    STANDBY,
    FLEET,
    DOORS,
    GUARDS,
    BACKUP,
    TOKENS,
    SELFTEST,
    DEMO,
    SURVEY,
    LOGBOOK,
    ADOPT,
    SSO,
    AUTHORITY,
    APPROVALS,
    METRICS,
    LIVE,
)


def memories(sections: Sections, relays: int) -> tuple[SharedMemory, ...]:
    return tuple(filter(None, (feature.memory(sections, relays) for feature in FEATURES)))


def recorded_messages() -> Any:
    return next((pkgutil.resolve_name(one.recorded) for one in FEATURES if one.recorded is not None), None)


def verb_function(group: str, name: str) -> Any:
    """Return the function of a feature's verb, for another feature; None without that feature."""
    verbs = (one.verbs[group] for one in FEATURES if group in one.verbs)
    found = (one.verbs[name] for one in verbs if isinstance(one, Group) and name in one.verbs)
    return next((pkgutil.resolve_name(one.path) for one in found if isinstance(one, Verb)), None)


def pairing_in(state: Path) -> "Pairing | None":
    found = (feature.pairing(state) for feature in FEATURES if feature.pairing is not None)
    return next(filter(None, found), None)


def machine_work_in(state: Path) -> "MachineWork | None":
    named = (feature.machine for feature in FEATURES if feature.machine is not None)
    return next((pkgutil.resolve_name(name)(state) for name in named), None)


def start_gate() -> Any:
    named = (feature.may_start for feature in FEATURES if feature.may_start is not None)
    return next((pkgutil.resolve_name(name)() for name in named), None)
