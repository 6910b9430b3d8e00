"""Make the parts of features for tests that do not call them."""

from appliance.audit.log.log import AuditLog
from appliance.channel.answers.graph_answers import Graph
from appliance.configuration.sections import DEFAULTS
from appliance.control.assembly.policies import Policies
from appliance.features.authority.control_part import request_methods
from appliance.features.authority.drive_orders import DriveOrders
from appliance.features.feature import FeatureContext, FeaturePart
from appliance.features.table import FeatureParts
from appliance.hosts.enrolment import HostEnrolment
from appliance.specifications.specification_manager import SpecificationManager
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail
from tests.support.idle import idle


def idle_parts() -> FeatureParts:
    """Return the parts of all features, with default settings and a log that records nothing."""
    store, monitors, hosts = idle(StateStore), idle(SpecificationManager), idle(HostEnrolment)
    store.settings = dict  # type: ignore[method-assign]  # an idle store has no settings
    early = FeatureContext(
        DEFAULTS, idle(AuditTrail), idle(AuditLog), "", charged_to=lambda host: host, in_force=lambda: (0, 0)
    )
    parts = FeatureParts(early)
    parts.operate(
        appliance="", store=store, policies=idle(Policies), monitors=monitors, hosts=hosts, processes=tuple,
        received=lambda _sequence: None, graph=lambda: Graph([], [], []), tokens_changed=lambda: None,
    )  # fmt: skip
    parts.add(FeaturePart(methods=request_methods(idle(DriveOrders))))
    return parts
