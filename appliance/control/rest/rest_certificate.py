"""Record a replaced certificate of REST, because clients that trust exactly the earlier one refuse it."""

import msgspec

from appliance.store.state_file import StateStore
from appliance.telemetry.audit_trail import AuditTrail

_SETTING = "certificate of REST"


class RestCertificate:
    """The last certificate of this appliance's api."""

    def __init__(self, store: StateStore, trail: AuditTrail, appliance: str) -> None:
        self._store, self._trail, self._appliance = store, trail, appliance

    def stated(self, sha256: str) -> None:
        known = msgspec.json.decode(self._store.settings().get(_SETTING, "{}"), type=dict[str, str])
        earlier = known.get(self._appliance, "")
        if not sha256 or sha256 == earlier:
            return
        self._store.save_setting(_SETTING, msgspec.json.encode(known | {self._appliance: sha256}).decode())
        if earlier:
            self._trail.happened(
                "rest certificate replaced",
                "REST has another certificate: copy certificate.pem to clients that trust exactly the earlier one",
                sha256=sha256,
                earlier=earlier,
            )
