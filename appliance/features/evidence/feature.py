"""Define the feature evidence."""

from typing import TYPE_CHECKING, Any

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import Feature, FeatureContext, FeaturePart

if TYPE_CHECKING:
    from appliance.channel.admin import AdminRequest

_VERBS = "appliance.features.evidence.evidence_verbs"


def _operations() -> "tuple[type[AdminRequest[Any]], ...]":
    from appliance.features.evidence.evidence_requests import (  # noqa: PLC0415  only processes with requests need it
        EvidenceExported,
        LogSealed,
    )

    return LogSealed, EvidenceExported


def _make(core: FeatureContext) -> FeaturePart:
    from appliance.control.operators.request_method import RequestMethod  # noqa: PLC0415  only control needs it
    from appliance.features.evidence.evidence_orders import EvidenceOrders  # noqa: PLC0415  as above
    from appliance.features.evidence.evidence_requests import EvidenceExported, LogSealed  # noqa: PLC0415  as above

    orders = EvidenceOrders(core.audit, core.trail, core.robot)
    return FeaturePart(
        methods=(
            RequestMethod(LogSealed, orders.seal),
            RequestMethod(EvidenceExported, orders.exported, who=True),
        )
    )


EVIDENCE = Feature(
    "evidence",
    operations=_operations,
    routes="appliance.features.evidence.evidence_routes:routes",
    verbs={
        "evidence": Group(
            "Export and verify signed evidence of an incident.",
            {
                "export": Verb(f"{_VERBS}:export_evidence"),
                "verify": Verb(f"{_VERBS}:verify"),
                "verifier": Verb(f"{_VERBS}:verifier"),
            },
            after="audit",
        )
    },
    make=_make,
)
