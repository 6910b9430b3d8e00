import asyncio
import hashlib
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.audit.log.log import AuditLog
from appliance.audit.log.record import Severity
from appliance.base.clock import wall_ns
from appliance.channel import admin
from appliance.channel.admin import AdminAnswer, AdminRequest, answer_to, verb_of
from appliance.channel.answers.monitor_answers import RevisionTexts
from appliance.channel.answers.policy_answers import PolicyKnown
from appliance.channel.operations import request_named
from appliance.features.evidence.bundle import RecordingSelection, TimeSpan, export
from appliance.features.evidence.control_part import EvidenceOrders, NotSealedError
from appliance.features.evidence.page import Names
from appliance.features.evidence.requests import EvidenceExported, LogSealed
from appliance.signing.fingerprints import fingerprint, fingerprint_of_all
from appliance.telemetry.audit_trail import AuditTrail
from tests.support.answers import example
from tests.support.audit import decision, settle
from tests.unit.audit.conftest import MakeLog, key, make_log, notary, path

__all__ = ["key", "make_log", "notary", "path"]

STRANGE: dict[str, Any] = {
    "text": 'é"\\\n\x1b \u2028\U0001f916',
    "number": 0.1,
    "large": 1e300,
    "whole": -(2**62),
    "deep": {"b": [1, None], "a": True},
}
NAMES = Names("arm-3", lambda host: f"tablet ({host})")
LENGTHS = (0, 1, 31, 32, 255, 256, 4000)
NUMBERS = (
    0, 1, -1, -32, -33, 127, 128, 255, 256, 65535, 65536, 2**32 - 1, 2**32, 2**63 - 1, -128, -129, -(2**31) - 1,
)  # fmt: skip


class Control:
    def __init__(self, log: AuditLog) -> None:
        self.log = log
        self.trail = AuditTrail(log, strict=False, deny_when_failed=False)
        self.orders = EvidenceOrders(log, self.trail, NAMES.robot)
        self.policies: dict[int, str] = {}
        self.specifications: dict[int, dict[str, str]] = {}
        self.begun = wall_ns()
        self.worked = 0
        self.recordings: dict[str, Any] = {}

    def load_policy(self, revision: int, text: str, **changes: Any) -> None:
        self.policies[revision] = text
        self.trail.revision = revision
        detail = {"sha256": fingerprint(text), "who": "disk", **changes}
        self.trail.happened("policy loaded", "it is in force", severity=Severity.NOTICE, more=detail)

    def load_specifications(self, revision: int, files: dict[str, str]) -> None:
        self.specifications[revision] = files
        detail = {"revision_of_specifications": revision, "sha256": fingerprint_of_all(files)}
        self.trail.happened("specifications loaded", "they are in force", category="monitor", more=detail)

    def work(self, count: int = 20) -> None:
        self.worked += count
        for number in range(self.worked - count, self.worked):
            length, whole = LENGTHS[number % len(LENGTHS)], NUMBERS[number % len(NUMBERS)]
            verdict = "deny" if number % 3 == 0 else "allow"
            self.log.record(
                decision(self.log, number, decision=verdict, detail={**STRANGE, "n": number}, resource="/r" * length,
                         duration_us=whole, revision=self.trail.revision, caller_id=None, reason=f"because {number}")
            )  # fmt: skip
        assert settle(self.log) is None

    def record(self, folder: Path, bag: bytes, **about: Any) -> RecordingSelection:
        digest = hashlib.sha256(bag).hexdigest()
        fetch: Any = request_named("recording fetch")
        recording: Any = example(
            answer_to(fetch), id="ab" * 10, began=self.begun, ended=wall_ns(), sha256=digest, **about
        )
        self.trail.happened("recording closed", "complete", recording=recording.id, sha256=digest)
        (folder / recording.id).mkdir()
        (folder / recording.id / "recording.bag").write_bytes(bag)
        self.recordings[recording.id] = recording
        return RecordingSelection(recording.id, folder)

    def ask(self, request: AdminRequest[Any]) -> AdminAnswer[Any]:
        try:
            body = self._answer(request)
        except NotSealedError as error:
            return AdminAnswer(False, error=str(error), trouble="failed")
        if body is None:
            return AdminAnswer(False, error="there is no such thing", trouble="unknown")
        return AdminAnswer(True, body)

    def _answer(self, request: AdminRequest[Any]) -> Any:
        if verb_of(request) == "recording fetch":
            return self.recordings.get(msgspec.structs.asdict(request)["id"])
        match request:
            case LogSealed():
                return asyncio.run(self.orders.seal(request))
            case EvidenceExported():
                return asyncio.run(self.orders.exported(request, "operator"))
            case admin.PolicyWanted(revision=int(revision)) if revision in self.policies:
                return example(
                    PolicyKnown, text=self.policies[revision], signature=f"signature of {revision}"
                )
            case admin.MonitorRevisionWanted(revision) if revision in self.specifications:
                named = self.specifications[revision]
                files = {name: text for name, text in named.items() if not name.startswith("msg/")}
                definitions = {name[4:]: text for name, text in named.items() if name.startswith("msg/")}
                signatures = dict.fromkeys([*files, *definitions], "signature")
                return example(RevisionTexts, files=files, definitions=definitions, signatures=signatures)
        return None

    def exported(self, place: Path, since: int | None = None, until: int | None = None) -> Path:
        span = TimeSpan(self.begun if since is None else since, wall_ns() + 1 if until is None else until)
        return self.export(span, place)

    def export(self, wanted: TimeSpan | RecordingSelection, place: Path) -> Path:
        place.write_bytes(b"".join(export(self.log.path, wanted, self.ask, NAMES)))
        return place


@pytest.fixture
def control(make_log: MakeLog) -> Control:
    running = Control(make_log(checkpoint_every=12, checkpoint_seconds=3600))
    running.load_policy(6, "[Nodes]\nold = *\n")
    running.load_policy(7, "[Nodes]\ndefault = *\né = *\n")
    running.load_specifications(2, {"a.rv": "a() { }", "msg/p/T.msg": "int32 x\n", "../b\n.rv": "b() { }"})
    running.work(5)
    running.begun = wall_ns()
    running.work()
    return running
