from typing import Any

from appliance.audit.log.log import AuditLog
from appliance.channel.answers.graph_answers import Graph
from appliance.channel.answers.status import Status
from appliance.configuration.sections import DEFAULTS
from appliance.control.assembly.policies import Policies
from appliance.control.operators.handled_alarms import HandledAlarms
from appliance.control.operators.node_connections import NodeConnections
from appliance.features.feature import Feature, FeatureContext
from appliance.features.parts import FeatureParts
from appliance.features.table import FEATURES
from appliance.specifications.specification_manager import SpecificationManager
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail
from tests.support.idle import idle


def idle_parts() -> FeatureParts:
    store, monitors, ends = idle(StateStore), idle(SpecificationManager), idle(EndTable)
    store.settings = dict  # type: ignore[method-assign]  # an idle store has no settings
    early = FeatureContext(
        DEFAULTS, idle(AuditTrail), idle(AuditLog), "", charged_to=lambda host: host, in_force=lambda: (0, 0)
    )
    parts = FeatureParts(early)
    parts.operate(
        appliance="", store=store, ends=ends, policies=idle(Policies), monitors=monitors, processes=tuple,
        received=lambda _sequence: None, graph=lambda: Graph([], [], []), tokens_changed=lambda: None,
        status=lambda: idle(Status), handled_alarms=idle(HandledAlarms),
        connections=idle(NodeConnections),
    )  # fmt: skip
    return parts


def answered_later() -> list[tuple[Feature, type[Any]]]:
    return [
        (feature, request)
        for feature in FEATURES
        if feature.operate is None and (feature.inherit is not None or feature.may_start is not None)
        for request in feature.operations()
    ]
