"""Find the uses of each rule of the policy in force, for `/v1/policy/uses`."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec

from appliance.audit.log.record_format import LogEntry
from appliance.audit.search.query import Filter
from appliance.audit.search.search import export
from appliance.channel.answers.graph_answers import Registration
from appliance.channel.answers.policy_answers import PolicyKnown
from appliance.features.policy_tools.policy_models import PolicyUses, RuleText, RuleUsed
from appliance.features.policy_tools.recorded_requests import RecordedPeriod, period_since
from appliance.features.policy_tools.rule_uses import RuleUses
from appliance.policy.judgement import PolicyContext
from appliance.policy.live_rights import LiveRight

MOST_READ = 100_000
"""The most records that one request reads, newest first in each kind. With more, what was not seen is unknown."""


def policy_uses(
    path: Path, current: PolicyKnown, registrations: Iterable[Registration], since: int, most: int = MOST_READ
) -> PolicyUses:
    """Return the uses since a time (nanoseconds since the epoch). Raises `LogUnreadableError`."""
    known = PolicyContext.of(msgspec.structs.asdict(current))
    policy = known.complete(known.compiled(current.text, current.file))
    records = _NewestRecords(path, most)
    period: RecordedPeriod = replace(period_since(partial(export, path), since, since), read=records)
    uses = RuleUses(policy)
    for request in period.requests():
        uses.add(request.observation, request.count)
    uses.add_live(LiveRight.of(msgspec.structs.asdict(row)) for row in registrations)
    removed = period.removed or records.cut
    return PolicyUses(
        revision=current.revision,
        since=period.start / 1e9,
        whole=not removed,
        rules=[
            RuleUsed(
                RuleText(row.rule.section, row.rule.key, row.rule.file, row.rule.line),
                row.state,
                row.used,
                list(row.unused),
                list(row.unknown),
            )
            for row in uses.rules(period.unnamed, removed=removed)
        ],
    )


class _NewestRecords:
    """Reads at most `left` records, newest first; `cut`: there are more."""

    def __init__(self, path: Path, left: int) -> None:
        self._path, self._left = path, left
        self.cut = False

    def __call__(self, wanted: Filter) -> Iterator[LogEntry]:
        for entry in export(self._path, wanted, newest_first=True):
            if self._left == 0:
                self.cut = True
                return
            self._left -= 1
            yield entry
