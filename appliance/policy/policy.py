"""A compiled policy, and the one pure function that decides: `Policy.decide(request)`.

1. An operator's block denies every request of its host, whatever the rules say, even in audit-only mode.
2. A request that no rule grants is denied, unless its section is an extension and the policy lacks it. One rule
   decides: the rule with the most specific matching key of its section, or `default`.
3. `Decision.reason` is a sentence shorter than 300 characters.
4. Memory does not grow with requests: answers are kept for at most `_KEPT_DECISIONS` short resource names, and hosts.
"""

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import tzinfo
from typing import NamedTuple, TypeVar

from appliance.policy import commands
from appliance.policy.authority import AuthorityGroup
from appliance.policy.host_sets import Atom, HostSets, Network, canonical_address
from appliance.policy.hours import ClosedTimes, Times, closed_times
from appliance.policy.keys import Key, KeyTree, is_parameter_key
from appliance.policy.model import Address, Category, Decision, Request, Rule
from appliance.policy.policy_findings import Place, PolicyFinding, quote
from appliance.policy.rate_limits import NO_LIMIT, LimitRule, LimitScope, LimitTable, Rate
from appliance.policy.sections import BY_CATEGORY, PARAMETERS
from roswire.names import is_global_name

K = TypeVar("K")
DEFAULT_PORTS = range(19001, 26001)

_LIMITED = {Category.PUBLISH: LimitScope.PUBLISHER, Category.SUBSCRIBE: LimitScope.SUBSCRIBER}
_COMMANDING = frozenset({Category.PUBLISH, Category.CALL})
_KEPT_DECISIONS, _KEPT_HOSTS = 8192, 1024
_KEPT_NAME = 256
_LONGEST_REASON = 299

Approval = tuple[Address, Category, str]
"""A right that an operator has approved: the host, the category, and the name of the topic, service or parameter."""


@dataclass(frozen=True, slots=True)
class CompiledRule:
    """One line of a deciding section.

    `key` is None for `default`. `words` is the value as written, `shown` as text for messages. `asked` has the atoms
    of hosts that need an approval.
    """

    rule: Rule
    key: Key | None
    atoms: frozenset[Atom]
    words: tuple[tuple[str, Atom], ...]
    shown: str
    place: str
    where: Place
    asked: frozenset[Atom] = frozenset()

    @property
    def hosts(self) -> frozenset[Atom]:
        return self.atoms | self.asked

    def asks(self, atoms: frozenset[Atom]) -> bool:
        return self.atoms.isdisjoint(atoms) and not self.asked.isdisjoint(atoms)

    def grants(self, atoms: frozenset[Atom]) -> bool:
        return not self.atoms.isdisjoint(atoms)

    def granted_through(self, atoms: frozenset[Atom]) -> tuple[str, ...]:
        return tuple(word for word, atom in self.words if atom in atoms)


@dataclass(slots=True)
class RuleTable:
    """The rules of a category; `audit_only`: requests that these rules deny still pass."""

    tree: KeyTree[CompiledRule] = field(default_factory=KeyTree)
    default: CompiledRule | None = None
    rules: list[CompiledRule] = field(default_factory=list)
    audit_only: bool = False


class HostStanding(NamedTuple):
    """The policy's answers about an address; they are computed once.

    `ever` are its atoms at any time, `atoms` those at the time of the policy.
    """

    atoms: frozenset[Atom]
    ever: frozenset[Atom]
    known: bool
    named: bool
    named_as: Network
    alike: str
    text: str


@dataclass(kw_only=True, eq=False, repr=False)
class Policy:
    """A compiled policy, which only `compile_policy` makes.

    `named` has the atoms of all hosts that a rule names. `blocks` has the end of a sentence for each blocked host,
    such as `blocked by ann`. A group without an entry in `holders` is free; without `holders` (for checks of a text),
    each host with a claim counts as the holder. Without `approved`, no request that needs an approval passes.
    `times` are the times of rights, `closed` those that grant nothing now; `zone` is that of local
    times.
    """

    text: str
    file: str
    warnings: tuple[PolicyFinding, ...]
    hosts: HostSets
    named: frozenset[Atom]
    tables: Mapping[Category, RuleTable]
    present: frozenset[Category]
    ports: range
    monitored_topics: frozenset[str]
    monitored_services: frozenset[str]
    limits: LimitTable
    authority: Mapping[str, AuthorityGroup]
    takeover: str
    tell: str
    enrolled: Mapping[str, Address]
    robot: tuple[Network, ...]
    times: Times
    closed: ClosedTimes
    zone: tzinfo
    blocks: Mapping[Address, str] = field(default_factory=dict)
    holders: Mapping[str, Address] | None = None
    approved: frozenset[Approval] | None = None
    kept: dict[tuple[int, int, Category, str], Decision] = field(default_factory=dict, init=False)
    _kept_below: dict[tuple[int, int, Category, str, bool], Decision] = field(
        default_factory=dict, init=False
    )

    standings: dict[Address, HostStanding] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self._any_audit_only = any(table.audit_only for table in self.tables.values())
        self._commanded = {name: group for group in self.authority.values() for name in group.names}

    def without_groups(self) -> "Policy":
        """Return the policy for monitors: a guard stops the robot even if another host holds the group."""
        return replace(self, authority={}) if self.authority else self

    def at(self, now: float | None, ends: Mapping[float, bool] | None = None) -> "Policy":
        """Return the policy as it decides at a time; both are those of `PolicyContext`."""
        return replace(self, closed=closed_times(self.times, now, ends or {})) if self.times else self

    def at_any_time(self) -> "Policy":
        """Return the policy as if each right with a time had begun, and none had ended."""
        return replace(self, closed={}) if self.times else self

    def plain(self) -> "Policy":
        """Return the policy without what operators decide: blocks, holders of groups, and approvals."""
        return replace(self, blocks={}, holders=None, approved=None)

    def decide(self, request: Request) -> Decision:
        """Decide by the rules of the request's own category; `policy/rights` decides on additional rights."""
        host = request.host
        key = (host.version, int(host), request.category, request.resource)
        decision = self.kept.get(key)
        if decision is None:
            decision = self._decide(request)
            _keep(self.kept, key, request, decision)
        return decision

    def decide_parameter(self, request: Request, *, namespace: bool = False) -> Decision:
        """Decide access to a parameter; a rule for a name below that denies the host denies the call.

        `namespace`: the parameter contains other parameters. Then the rule for those without their own key must also
        grant the host, because an exact key `/arm` does not match `/arm/speed`.
        """
        decision = self.decide(request)
        if not decision.allowed or decision.would_deny or request.category not in self.present:
            return decision
        host = request.host
        key = (host.version, int(host), request.category, request.resource, namespace)
        kept = self._kept_below.get(key)
        if kept is None:
            kept = self._decide_below(request, namespace) or decision
            _keep(self._kept_below, key, request, kept)
        return kept

    def _decide_below(self, request: Request, namespace: bool) -> Decision | None:
        table = self.tables[request.category]
        atoms = self.atoms_of(request.host)
        deciding = table.tree.below(request.resource)
        if namespace:
            inherited = table.tree.inherited_value(request.resource) or table.default
            if inherited is None:
                reason = f"{self._what(request, 'may not')}: no key of [Parameters] matches what is below it"
                return _decision(False, None, reason, table.audit_only)
            deciding.append(inherited)
        denying = [rule for rule in deciding if not rule.grants(atoms)]
        for rule in sorted(
            denying, key=lambda rule: rule.asks(atoms)
        ):  # an approval cannot help against a denial
            if not rule.asks(atoms):
                what = f"{self._what(request, 'may not')} with what is below it"
                return _by_rule(what, rule, table.audit_only)
            return self._asking(request, rule, table.audit_only)
        return None

    def limit_rule(self, topic: str) -> LimitRule | None:
        return self.limits.find(topic) if self.limits.rules else None

    def limit(self, part: LimitScope, topic: str, host: Address | None = None) -> Rate:
        """Return the limit for a host, or without `host` for all publishers together. No limit is `NO_LIMIT` itself."""
        rule = self.limit_rule(topic)
        if rule is None:
            return NO_LIMIT
        return rule.rate(part, self.standing(host).ever if host is not None else frozenset())

    def limit_on(self, request: Request) -> Rate:
        part = _LIMITED.get(request.category)
        return NO_LIMIT if part is None else self.limit(part, request.resource, request.host)

    def standing(self, address: Address) -> HostStanding:
        standing = self.standings.get(address)
        if standing is None:
            if len(self.standings) >= _KEPT_HOSTS:
                self.standings.clear()
            standing = self.standings[address] = self._standing(address)
        return standing

    def _standing(self, address: Address) -> HostStanding:
        text, network = str(canonical_address(address)), self.hosts.narrowest(address)
        ever, named_as = self.hosts.atoms_of(address), network or ipaddress.ip_network(text)
        atoms = self.hosts.atoms_of(address, self.closed) if self.closed else ever
        free, learned = self.block_of(address) is None, self._any_audit_only and not self.named
        known = free and (learned or not self.named.isdisjoint(atoms))
        return HostStanding(atoms, ever, known, free and network is not None, named_as, str(named_as), text)

    def knows(self, address: Address) -> bool:
        """Return whether a rule includes this address, and the host is not blocked.

        In audit-only mode without a rule that names a host, every host is known, because a robot is being learned.
        """
        return self.standing(address).known

    def times_of(self, address: Address, hosts: frozenset[Atom]) -> list[Atom]:
        """Return the times with which the host is among `hosts`; none if it also is without."""
        if not self.times or not hosts.isdisjoint(self.hosts.atoms_of(address, self.times)):
            return []
        times = self.standing(address).ever.intersection(self.times)
        return [atom for atom in sorted(times) if not hosts.isdisjoint(self.hosts.above([atom]))]

    def open_to(self, address: Address, hosts: frozenset[Atom]) -> str:
        """Return the times by which the host is among `hosts` now, or an empty text if it always is."""
        limits = [self.times[atom].limit for atom in self.times_of(address, hosts) if atom not in self.closed]
        return " or ".join(dict.fromkeys(limits))

    def closed_to(self, address: Address, hosts: frozenset[Atom]) -> str:
        """Return why the host is not among `hosts` now although it is at another time, or an empty text."""
        closed = [self.closed[atom].why for atom in self.times_of(address, hosts) if atom in self.closed]
        return f"its right {' and '.join(dict.fromkeys(closed[:2]))}" if closed else ""

    def why_unnamed(self, address: Address) -> str:
        """Return why `knows` is false for a host that is not blocked."""
        closed = self.closed_to(address, self.named)
        return f"no rule of the policy names {self.standing(address).text}" + (
            f" now: {closed}" if closed else ""
        )

    def serves(self, address: Address) -> bool:
        return self.knows(address) or (self._any_audit_only and self.block_of(address) is None)

    def block_of(self, address: Address) -> Decision | None:
        if not self.blocks or (block := self.blocks.get(host := canonical_address(address))) is None:
            return None
        return Decision(False, None, f"{host} is {block}", told=f"{host} is blocked by an operator")

    def command_group(self, name: str) -> AuthorityGroup | None:
        return self._commanded.get(name)

    def may_command(self, name: str, host: Address) -> bool:
        group = self._commanded.get(name)
        if group is None:
            return True
        if self.holders is None or group.ranks:
            return group.claim(self.atoms_of(host)) is not None
        return self.holder(group) == canonical_address(host)

    def holder(self, group: AuthorityGroup) -> Address | None:
        host = (self.holders or {}).get(group.name)
        if host is None or self.block_of(host) is not None or group.claim(self.atoms_of(host)) is None:
            return None
        return host

    def asks_for(self, category: Category, name: str) -> bool:
        rule = self.tables[category].tree.find(name) or self.tables[category].default
        return rule is not None and bool(rule.asked)

    def named_as(self, address: Address) -> Network:
        return self.standing(address).named_as

    def alike(self, address: Address) -> str:
        return self.standing(address).alike

    def counted_as(self, address: Address) -> str:
        """Return the key of a host in tables by host: equal for hosts that count as one, empty for unknown hosts."""
        return self.alike(address) if self.knows(address) else ""

    def names(self, address: Address) -> bool:
        """Return whether a rule names the host; `*` does not name hosts, and a blocked host does not count."""
        return self.standing(address).named

    @property
    def all_audit_only(self) -> bool:
        """Whether no section denies anything."""
        return all(table.audit_only for table in self.tables.values())

    def audit_only(self, category: Category) -> bool:
        return self.tables[category].audit_only

    def atoms_of(self, address: Address) -> frozenset[Atom]:
        return self.standing(address).atoms

    def rules(self, category: Category) -> tuple[CompiledRule, ...]:
        return tuple(self.tables[category].rules)

    def _decide(self, request: Request) -> Decision:
        denial = self.block_of(request.host)
        if denial is not None:
            return denial
        category = request.category
        name = request.resource
        if category is Category.COMMAND:
            name = commands.ALIASES.get(name, name)
            if name not in commands.COMMANDS:
                return Decision(False, None, _not_a_command(name))
        elif not (is_parameter_key(name) if category in PARAMETERS else is_global_name(name)):
            return Decision(False, None, f"{quote(name)} is not a resolved ROS name")
        table = self.tables[category]
        found = table.tree.find(name)
        if category is Category.COMMAND and name in commands.NAMED_ONLY:
            return self._decide_named_only(request, table, found)
        if category in self.present:
            decision = self._apply(request, table, found or table.default)
        else:
            decision = self._without_section(request, table)
        group = self._commanded.get(name) if category in _COMMANDING else None
        return decision if group is None else self._commanding(request, decision, group)

    def _commanding(self, request: Request, decision: Decision, group: AuthorityGroup) -> Decision:
        """Deny a host without a claim to the group, and calls of a host that does not hold it.

        A publication of a host with a claim stays registered, because a ROS 1 node never registers again; the relay
        carries its messages only while the host holds the group, or while its node moves and no higher rank does.
        """
        if not decision.allowed and decision.asks is None:
            return decision
        may_not = self._what(request, "may not")
        if group.claim(self.atoms_of(request.host)) is None:
            lets = "names it in the rank" if group.ranks else "lets it take, override or ask"
            reason = f"{may_not}: no line of {place_of(group.rule)} {lets}"
            return Decision(False, group.rule, reason)
        if group.ranks:
            return self._apply_rank(request, decision, group)
        holder = self.holder(group)
        now = "" if self.holders is None else f"; now {holder or 'no host'} holds it"
        if request.category is Category.CALL and not self.may_command(request.resource, request.host):
            order = group.order(request.host, self.atoms_of(request.host), holder)
            told = f"{may_not} while it does not hold {group.name}: {order}"
            return Decision(False, group.rule, told + now, told=told)
        return _extend(decision, f", while it holds {group.name}{now}")

    def _apply_rank(self, request: Request, decision: Decision, group: AuthorityGroup) -> Decision:
        """Deny calls: only messages have a rank."""
        if request.category is Category.CALL:
            told = f"{self._what(request, 'may not')}: {group.name} has a rank, which services cannot have"
            return Decision(False, group.rule, told)
        line = " > ".join(group.in_words(rank) for rank in range(len(group.ranks)))
        return _extend(decision, f", while it moves and no higher rank of {group.name} does: {line}")

    def _decide_named_only(self, request: Request, table: RuleTable, rule: CompiledRule | None) -> Decision:
        if rule is None:
            reason = (
                f"{self._what(request, 'may not')}: only its own key in [Commands] grants it, never default"
            )
            return Decision(False, None, reason)
        decision = self._apply(request, table, rule)
        # audit-only is for learning the needs of a robot. No robot needs these calls, so they stay denied.
        return replace(decision, allowed=False, would_deny=False) if decision.would_deny else decision

    def _apply(self, request: Request, table: RuleTable, found: CompiledRule | None) -> Decision:
        if found is None:
            section = BY_CATEGORY[request.category].name
            reason = f"{self._what(request, 'may not')}: no key of [{section}] matches and it has no default"
            return _decision(False, None, reason, table.audit_only)
        atoms = self.atoms_of(request.host)
        if found.grants(atoms):
            reason = f"{self._what(request, 'may')} by {found.place}"
            timed = f"{reason}, {self.open_to(request.host, found.hosts)}" if self.times else reason
            fits = len(reason) + 2 < len(timed) <= _LONGEST_REASON
            return Decision(True, found.rule, timed if fits else reason)
        if found.asks(atoms):
            return self._asking(request, found, table.audit_only)
        what = self._what(request, "is not among the hosts that may")
        closed = self.closed_to(request.host, found.hosts)
        now = f"{what} now, because {closed}" if closed else what
        fits = len(now) + len(found.place) < _LONGEST_REASON - len(", by ")
        return _by_rule(now if fits else what, found, table.audit_only)

    def _asking(self, request: Request, rule: CompiledRule, audit_only: bool) -> Decision:
        """Return the decision on a request that needs an approval.

        A service call passes, because the relay holds each of its requests.
        """
        if self._is_approved(request):
            reason = f"{self._what(request, 'may')} by {rule.place}, while an approval lasts"
            return Decision(True, rule.rule, reason, asks=request)
        reason = f"{self._what(request, 'needs an approval to')}, by {rule.place}"
        if audit_only:
            return _decision(False, rule.rule, reason, audit_only)
        held = self.approved is not None and request.category is Category.CALL
        return Decision(held, rule.rule, reason, asks=request)

    def _is_approved(self, request: Request) -> bool:
        approval = canonical_address(request.host), request.category, request.resource
        return self.approved is not None and approval in self.approved

    def _what(self, request: Request, may: str) -> str:
        phrase = BY_CATEGORY[request.category].phrases[request.category]
        return f"{self.standing(request.host).text} {may} {phrase} {_shorten(request.resource)}"

    def _without_section(self, request: Request, table: RuleTable) -> Decision:
        decider = BY_CATEGORY[request.category]
        if decider.extension:
            deed = f"{decider.phrases[request.category]} {_shorten(request.resource)}"
            return Decision(True, None, f"no [{decider.name}] section: every host may {deed}")
        reason = (
            f"{self._what(request, 'may not')}: the policy has no [{decider.name}] section, so no host may"
        )
        return _decision(False, None, reason, table.audit_only)


class CurrentPolicy:
    """The policy in force, which is replaced as a whole. It is false until the first one is set."""

    def __init__(self) -> None:
        self._policy: Policy | None = None

    def __bool__(self) -> bool:
        return self._policy is not None

    def __call__(self) -> Policy:
        if self._policy is None:
            raise RuntimeError("no policy is in force yet")
        return self._policy

    def set(self, policy: Policy) -> None:
        self._policy = policy


def _keep(decisions: dict[K, Decision], key: K, request: Request, decision: Decision) -> None:
    if len(request.resource) <= _KEPT_NAME:
        if len(decisions) >= _KEPT_DECISIONS:
            decisions.clear()
        decisions[key] = decision


def _not_a_command(name: str) -> str:
    elsewhere = commands.DECIDED_ELSEWHERE.get(name)
    if elsewhere is not None:
        return f"{name} is decided by {elsewhere}"
    return f"{quote(name)} is not a call that the appliance knows"


def _decision(allowed: bool, rule: Rule | None, reason: str, audit_only: bool) -> Decision:
    if audit_only and not allowed:
        return Decision(True, rule, reason, would_deny=True)
    return Decision(allowed, rule, reason)


def _by_rule(what: str, rule: CompiledRule, audit_only: bool) -> Decision:
    told = f"{what}, by {rule.place}"
    reason = f"{what}: {rule.shown}, by {rule.place}"
    decision = _decision(False, rule.rule, reason if len(reason) <= _LONGEST_REASON else told, audit_only)
    return replace(decision, told=told)


def _extend(decision: Decision, addition: str) -> Decision:
    """Add to the reason what names other hosts, which the caller may not learn."""
    if len(decision.reason) + len(addition) > _LONGEST_REASON:
        return decision
    return replace(decision, reason=decision.reason + addition, told=decision.told or decision.reason)


def _shorten(text: str, limit: int = 60) -> str:
    shown = text if len(text) <= limit else text[: limit - 1] + "…"
    return shown if shown.isprintable() else quote(text, limit)


def place_of(rule: Rule) -> str:
    file = rule.file.rpartition("/")[2]
    return f"[{rule.section}] {_shorten(rule.key, 50)} ({_shorten(file, 30)}:{rule.line})"
