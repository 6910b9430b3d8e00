"""Compile a policy. An invalid section or value is left out, so that all errors are reported at once."""

from collections.abc import Collection, Mapping

from appliance.base.validation_messages import meant, nearest
from appliance.policy import sections
from appliance.policy.authority import read_authority
from appliance.policy.groups import HostGroups
from appliance.policy.host_sets import HostSets, Network
from appliance.policy.hours import closed_times
from appliance.policy.ini_reader import SectionText, read
from appliance.policy.model import Address, Category
from appliance.policy.policy import Policy
from appliance.policy.policy_findings import Findings, quote
from appliance.policy.policy_lint import lint
from appliance.policy.policy_settings import read_monitor, read_options, read_ports
from appliance.policy.rate_limits import read_limits
from appliance.policy.rules import RuleCompiler


def compile_policy(
    text: str,
    *,
    file: str,
    hosts: Mapping[str, Address] | None = None,
    robot: Collection[Address | Network] = (),
    own: Collection[Address] = (),
    now: float | None = None,
    ends: Mapping[float, bool] | None = None,
) -> Policy:
    """Return the policy. Raises `PolicyError` with every error in the text.

    `now` is the time by which it decides, in seconds since the epoch. Without it, rights with a time grant nothing.

    `own` are further addresses of the robot's machine. They are in the group `robot`, unless the text names them.
    A name in `hosts` without an address matches no host and causes a warning.
    """
    findings = Findings(file)
    written = _by_name(read(text, findings), findings)
    table = HostSets()
    groups = HostGroups(table, findings, hosts or {}, robot, now)
    groups.define(written.get(sections.GROUPS), written.get(sections.HOURS))
    options = read_options(written.get(sections.OPTIONS), findings)
    ports = read_ports(written.get(sections.PORTS), findings)
    monitor = read_monitor(written.get(sections.MONITOR), findings)
    limits = read_limits(written.get(sections.LIMITS), file, groups, findings)
    authority = read_authority(written.get(sections.AUTHORITY), file, groups, findings)
    compiler = RuleCompiler(file, groups, findings)
    present: set[Category] = set()
    for decider in sections.DECIDERS:
        section = written.get(decider.name)
        if section is not None:
            compiler.add_section(decider, section)
            present.update(decider.categories)
        for category in decider.categories:
            compiler.tables[category].audit_only = decider.name in options.audit_only
    groups.add_own(own)
    groups.hours.warn_unused()
    findings.raise_errors()
    lint(compiler.tables, present, written, groups=groups, hosts=table, findings=findings)
    named = {atom for rules in compiler.tables.values() for rule in rules.rules for atom in rule.hosts}
    return Policy(
        text=text,
        file=file,
        warnings=tuple(sorted(findings.warnings)),
        hosts=table,
        named=frozenset(named),
        tables=compiler.tables,
        present=frozenset(present),
        ports=ports,
        monitored_topics=monitor.topics,
        monitored_services=monitor.services,
        limits=limits,
        authority=authority,
        takeover=options.takeover,
        tell=options.tell,
        enrolled=dict(hosts or {}),
        robot=groups.robot,
        times=groups.times,
        closed=closed_times(groups.times, now, ends or {}),
        zone=groups.hours.zone,
    )


def _by_name(texts: list[SectionText], findings: Findings) -> dict[str, SectionText]:
    by_fold = {name.casefold(): name for name in sections.NAMES}
    there = {section.name.text.casefold() for section in texts}
    by_name: dict[str, SectionText] = {}
    for section in texts:
        place = section.name
        name = by_fold.get(place.text.casefold())
        if name is None:
            guess = meant(place.text, sections.NAMES)
            known = "" if guess else f"; sections are {', '.join(sections.NAMES)}"
            findings.error(place, f"unknown section {quote(place.text)}{guess}{known}")
            name = nearest(place.text, sections.NAMES)
            if name is not None and name.casefold() not in there:
                by_name.setdefault(name, section)  # use the intended name: one mistake causes one error
        elif name in by_name:
            first = by_name[name]
            text = f"the section [{name}] is already defined at line {first.name.line}: move its lines there"
            findings.error(place, text)
            first.entries.extend(section.entries)
        else:
            by_name[name] = section
    return by_name
