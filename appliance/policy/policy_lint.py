"""Warn about valid rules that the author most likely did not intend; warnings never reject a policy."""

import bisect
import ipaddress
from collections.abc import Mapping

from appliance.policy import sections
from appliance.policy.commands import CALLS
from appliance.policy.groups import HostGroups
from appliance.policy.host_sets import EVERYONE, Atom, HostSets, Network
from appliance.policy.ini_reader import SectionText
from appliance.policy.model import Category
from appliance.policy.policy import CompiledRule, RuleTable
from appliance.policy.policy_findings import Findings, Place, quote

Tables = Mapping[Category, RuleTable]
_NODE_CATEGORIES = (Category.PUBLISH, Category.SUBSCRIBE, Category.OFFER)


def lint(
    tables: Tables,
    present: set[Category],
    written: Mapping[str, SectionText],
    *,
    groups: HostGroups,
    hosts: HostSets,
    findings: Findings,
) -> None:
    _shadowed_defaults(tables, findings)
    _dead_rules(tables, hosts, findings)
    _nodes_that_cannot_start(tables, present, written, findings)
    _unused_groups(groups, findings)
    _missing_sections(present, findings)


def _shadowed_defaults(tables: Tables, findings: Findings) -> None:
    for table in tables.values():
        everything = [r for r in table.rules if r.key and r.key.text == "/**"]
        if everything and table.default:
            line = everything[0].rule.line
            text = f"never decides: {everything[0].rule.key} at line {line} matches every name before it"
            findings.warn(table.default.where, text)


def _dead_rules(tables: Tables, table: HostSets, findings: Findings) -> None:
    named = {atom for rule in tables[Category.NODE].rules for atom in rule.atoms}
    if not named.isdisjoint(table.above([EVERYONE])):
        return
    nameless = _nameless(named, table)
    seen: dict[Network, tuple[CompiledRule, int]] = {}
    for rule in (rule for category in _NODE_CATEGORIES for rule in tables[category].rules):
        for host in {nameless[atom] for atom in rule.hosts if atom in nameless}:
            first, count = seen.get(host, (rule, 0))
            seen[host] = (first, count + 1)
    for host, (rule, count) in seen.items():
        shown = str(host).removesuffix("/32").removesuffix("/128")
        more = f" ({count} rules)" if count > 1 else ""
        text = f"{shown} may not use any node name ([Nodes]), so {rule.rule.key} grants it nothing{more}"
        findings.warn(rule.where, text)


def _nameless(named: set[Atom], table: HostSets) -> dict[Atom, Network]:
    networks = table.networks()
    nodes = [network for network, atom in networks.items() if not named.isdisjoint(table.above([atom]))]
    overlap = _Overlap(nodes)
    nameless: dict[Atom, Network] = {}
    for network, atom in networks.items():
        if not overlap.any(network):
            waiting = [atom]
            while waiting:
                holder = waiting.pop()
                if holder not in nameless:
                    nameless[holder] = network
                    waiting.extend(table.parents(holder))
    return nameless


class _Overlap:
    def __init__(self, networks: list[Network]) -> None:
        self._starts: dict[int, list[int]] = {}
        self._ends: dict[int, list[int]] = {}
        v4 = [network for network in networks if isinstance(network, ipaddress.IPv4Network)]
        v6 = [network for network in networks if isinstance(network, ipaddress.IPv6Network)]
        whole: list[Network] = [*ipaddress.collapse_addresses(v4), *ipaddress.collapse_addresses(v6)]
        for network in whole:
            self._starts.setdefault(network.version, []).append(int(network.network_address))
            self._ends.setdefault(network.version, []).append(int(network.broadcast_address))

    def any(self, network: Network) -> bool:
        starts = self._starts.get(network.version, [])
        before = bisect.bisect_right(starts, int(network.broadcast_address)) - 1
        return before >= 0 and self._ends[network.version][before] >= int(network.network_address)


def _nodes_that_cannot_start(
    tables: Tables, present: set[Category], written: Mapping[str, SectionText], findings: Findings
) -> None:
    if Category.COMMAND not in present:
        return
    table = tables[Category.COMMAND]
    place = written["Commands"].name
    for command, call in CALLS.items():
        rule = table.tree.find(command) or table.default
        if call.at_start and (rule is None or not rule.atoms):
            text = f"{command} is granted to no host, and a node needs it: {call.at_start}"
            findings.warn(rule.where if rule else place, text)


def _unused_groups(groups: HostGroups, findings: Findings) -> None:
    for name, group in groups.groups.items():
        if not group.used and group.word is not None:
            findings.warn(group.word, f"the group {quote(name)} is not used")


def _missing_sections(present: set[Category], findings: Findings) -> None:
    for decider in sections.DECIDERS:
        if decider.categories[0] in present:
            continue
        effect = "denied for all hosts"
        if decider.extension:
            keys = (
                f"{category} default" if len(decider.phrases) > 1 else "default"
                for category in decider.phrases
            )
            effect = f"allowed for all hosts: add it, with {' and '.join(f'{key} = HOSTS' for key in keys)}"
        findings.warn(Place(), f"there is no [{decider.name}] section, so its requests are {effect}")
