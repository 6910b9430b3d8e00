"""Find the decisions and limits that another policy would change, before a reload."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

from appliance.policy.model import Decision, Request
from appliance.policy.policy import Policy
from appliance.policy.rights import Right, decide, rights_of


@dataclass(frozen=True, slots=True)
class Difference:
    """A changed decision; `count` is the number of occurrences of the request."""

    request: Request
    old: Decision
    new: Decision
    count: int
    limited: int = 0
    """The change of the limit if both policies allow the request: -1 for a stricter limit, 1 for a weaker one."""

    @property
    def granted(self) -> bool:
        """Whether the new policy grants a request that the old one denied, or limits it less."""
        return self.new.rank > self.old.rank or self.limited > 0

    @property
    def word(self) -> str:
        if self.limited:
            return "limited" if self.limited < 0 else "limited less"
        if self.new.verdict == "ask":
            return "needs approval"
        return "granted" if self.granted else "denied"


def diff(old: Policy, new: Policy, requests: Iterable[Request | Right]) -> list[Difference]:
    """Return the requests in order of first occurrence; a `Right` is decided alone, a request with all its rights.

    A request that passes only because of audit-only mode is not the same as a granted request.
    """
    counts: dict[Request | Right, int] = {}
    for request in requests:
        counts[request] = counts.get(request, 0) + 1
    differences = (_difference(old, new, request, count) for request, count in counts.items())
    return [
        difference
        for difference in differences
        if difference.old.rank != difference.new.rank or difference.limited
    ]


def _difference(old: Policy, new: Policy, asked: Request | Right, count: int) -> Difference:
    request, rights = (asked.request, [asked]) if isinstance(asked, Right) else (asked, rights_of(asked))
    before, after = decide(old, rights), decide(new, rights)
    was, now = old.limit_on(request), new.limit_on(request)
    if was == now or not (before.allowed and after.allowed):
        return Difference(request, before, after, count)
    return Difference(
        request,
        replace(before, reason=f"{before.reason}; {was} in [Limits]"),
        replace(after, reason=f"{after.reason}; {now} in [Limits]"),
        count,
        1 if was == was.strictest(now) else -1,
    )
