"""Find the rules of a policy that no recorded request needed. No I/O.

A recorded request is decided again by the policy, right by right, so it also uses the rules that granted its command,
its parameter and its node name, and rules that have moved since. Registrations that live on count, however old.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

from appliance.features.policy_tools.learn import Observation, needed_rights
from appliance.policy.actions import BadWordError
from appliance.policy.host_sets import Atom
from appliance.policy.live_rights import LiveRight
from appliance.policy.model import Category, Rule, address_of
from appliance.policy.policy import CompiledRule, Policy
from appliance.policy.rights import Right, decide_right, request_of, rights_to_keep

State = Literal["used", "unused", "unknown"]
SEVERAL = "*"
"""The key of requests of several hosts in `unnamed`."""


@dataclass(frozen=True, slots=True)
class RuleUse:
    """A rule that grants something. `unused` and `unknown` are the words of hosts that did not use it, or perhaps.

    `ended` are the words of hosts whose rights have ended, used or not.
    """

    rule: Rule
    category: Category
    used: int
    unused: tuple[str, ...]
    unknown: tuple[str, ...]
    ended: tuple[str, ...] = ()

    @property
    def state(self) -> State:
        return "unused" if self.unused else "unknown" if self.unknown else "used"


@dataclass
class RuleUses:
    """Counts what a policy's rules granted."""

    policy: Policy
    _counts: dict[Rule, int] = field(default_factory=dict)
    _atoms: dict[Rule, set[Atom]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._ended = {word for word, closed in self.policy.closed.items() if closed.for_good}
        self.policy = self.policy.at_any_time()  # as the recorded requests were decided, each in its time

    def add(self, observation: Observation) -> None:
        try:
            rights = [Right(request) for request in needed_rights(observation)]
        except BadWordError:  # an unknown call, or a name that is none: no rule grants it
            return
        self._use(rights, observation.count)

    def add_live(self, live: Iterable[LiveRight]) -> None:
        for thing in live:
            request = request_of(thing.call, thing.host, thing.caller_id, thing.resource)
            self._use(rights_to_keep(request, thing.call, thing.resource, namespace=thing.namespace), 1)

    def _use(self, rights: Iterable[Right], count: int) -> None:
        for right in rights:
            decision = decide_right(self.policy, right)
            rule = decision.rule
            if rule is None or decision.would_deny or not (decision.allowed or decision.asks):
                continue
            self._counts[rule] = self._counts.get(rule, 0) + count
            self._atoms.setdefault(rule, set()).update(self.policy.atoms_of(right.request.host))

    def rules(self, unnamed: Mapping[str, int], *, removed: bool) -> Iterator[RuleUse]:
        """Yield a row for each rule that grants something, in the order of the sections.

        `unnamed` and `removed` are those of `RecordedPeriod`: what was not seen is unknown where it may be among
        requests that the log no longer names.
        """
        perhaps = self._atoms_of(unnamed)
        for category in Category:
            for rule in self.policy.rules(category):
                if rule.words:
                    yield self._row(category, rule, perhaps, removed=removed or SEVERAL in unnamed)

    def _atoms_of(self, unnamed: Mapping[str, int]) -> Collection[Atom]:
        hosts = (address_of(host) for host in unnamed if host != SEVERAL)
        return {atom for host in hosts for atom in self.policy.atoms_of(host)}

    def _row(
        self, category: Category, rule: CompiledRule, perhaps: Collection[Atom], *, removed: bool
    ) -> RuleUse:
        seen = self._atoms.get(rule.rule, set())
        unseen = [(word, atom) for word, atom in rule.words if atom not in seen]
        unknown = tuple(word for word, atom in unseen if removed or atom in perhaps)
        unused = tuple(word for word, _ in unseen if word not in unknown)
        ended = tuple(word for word, atom in rule.words if atom in self._ended)
        return RuleUse(rule.rule, category, self._counts.get(rule.rule, 0), unused, unknown, ended)
