"""What would be decided differently by another policy: the question before every reload."""

from collections.abc import Iterable
from dataclasses import dataclass

from appliance.policy.model import Decision, Request
from appliance.policy.policy import Policy


@dataclass(frozen=True, slots=True)
class Difference:
    """One request that the two policies decide differently; `count` says how often it was given."""

    request: Request
    old: Decision
    new: Decision
    count: int

    @property
    def granted(self) -> bool:
        """Whether the new policy gives what the old one denied."""
        return _answer(self.new) > _answer(self.old)


def diff(old: Policy, new: Policy, requests: Iterable[Request]) -> list[Difference]:
    """The requests, each once, that `new` decides differently, in the order they were first seen.

    A request that passes only because of audit-only mode differs from one that a rule grants.
    """
    counts: dict[Request, int] = {}
    for request in requests:
        counts[request] = counts.get(request, 0) + 1
    differences = (
        Difference(request, old.decide_with_node(request), new.decide_with_node(request), count)
        for request, count in counts.items()
    )
    return [difference for difference in differences if _answer(difference.old) != _answer(difference.new)]


def _answer(decision: Decision) -> int:
    if decision.would_deny:
        return 1
    return 2 if decision.allowed else 0
