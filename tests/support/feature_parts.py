"""Make the parts of features for tests that do not call them."""

from appliance.audit.log.log import AuditLog
from appliance.configuration.sections import DEFAULTS
from appliance.features.feature import FeatureContext
from appliance.features.table import FeatureParts
from appliance.telemetry.audit_trail import AuditTrail
from tests.support.idle import idle


def idle_parts() -> FeatureParts:
    """Return the parts of all features, with default settings and a log that records nothing."""
    core = FeatureContext(
        DEFAULTS, idle(AuditTrail), idle(AuditLog), "", charged_to=lambda host: host, in_force=lambda: (0, 0)
    )
    return FeatureParts(core)
