"""The iptables back end: legacy xtables through python-iptables (libiptc), IPv4 and IPv6.

Address translation needs nft, because the library cannot build the NAT targets of current xtables. The library caches
each table, with the namespace in which it was opened, for the whole process, so each call opens its tables in a
thread inside the namespace, one call at a time, under the lock of the `iptables` programs.
"""

import contextlib
import fcntl
import os
import subprocess
import threading
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from appliance.network.firewall.backend import BackendMissingError, FirewallError, RuleCounter
from appliance.network.firewall.firewall_rules import (
    COUNTED_MARK,
    HOOKS,
    SOURCE_TRANSLATIONS,
    Chain,
    Family,
    Interface,
    PacketRule,
    PacketVerdict,
)
from appliance.network.namespaces import Namespace

if TYPE_CHECKING:
    import iptc

LOCK = Path("/run/xtables.lock")  # the lock of the `iptables-legacy` programs
_ONE_AT_A_TIME = threading.Lock()  # guards the library's global state
_EXPIRE_MILLISECONDS = 10_000
_MODPROBE_SECONDS = 20.0
_MATCH_HEADER = 32  # bytes of struct xt_entry_match before its content

_CHAINS = (Chain.IN, Chain.OUT, Chain.FORWARD)

Extension = tuple[str, tuple[tuple[str, str | tuple[str, ...]], ...]]


@dataclass(frozen=True)
class HeaderMatch:
    """The matches of an IP header, and of the interfaces."""

    protocol: str | None = None
    in_interface: str | None = None
    out_interface: str | None = None
    source: str | None = None
    destination: str | None = None


@dataclass(frozen=True)
class RenderedRule:
    """A rule in the terms of xtables, as in `iptables -A CHAIN …`."""

    chain: str
    family: Family
    header: HeaderMatch
    matches: tuple[Extension, ...]
    target: Extension


class IptablesBackend:
    """The rules of one namespace in iptables."""

    name = "iptables"

    def __init__(self, namespace: Namespace, chains: tuple[Chain, ...] = _CHAINS) -> None:
        self._namespace = namespace
        self._chains = chains

    @property
    def families(self) -> tuple[Family, ...]:
        return self._namespace.run(_families)

    def install(self, rules: tuple[PacketRule, ...]) -> None:
        elsewhere = [rule.purpose for rule in rules if rule.chain not in self._chains]
        if elsewhere:
            raise BackendMissingError(f"address translation needs nft, not iptables: {'; '.join(elsewhere)}")
        timed = [rule.purpose for rule in rules if rule.seconds is not None]
        if timed:
            raise BackendMissingError(f"rules for some seconds need nft, not iptables: {'; '.join(timed)}")
        rendered = [line for rule in rules for line in render_rule(rule)]
        self._in_tables(lambda table: table.replace(rendered, self._chains))

    def remove(self) -> None:
        """Remove the rules, and create no unused table."""
        _in_used_tables(self._namespace, "filter", lambda table: table.replace([], self._chains))

    def counters(self) -> tuple[RuleCounter, ...]:
        counters: list[RuleCounter] = []
        self._in_tables(lambda table: counters.extend(table.counters(self._chains)))
        return tuple(counters)

    def _in_tables(self, work: "Callable[[_Table], None]") -> None:
        def inside() -> None:
            with _ONE_AT_A_TIME, _xtables_lock():
                for family in _families():
                    with _open(family) as table:
                        work(table)

        self._namespace.run(inside)


def load_modules() -> None:
    """Load the kernel's modules while the process still may; a failure appears only as an error of `install`."""
    command = ["modprobe", "--quiet", "--all", "ip_tables", "ip6_tables"]
    with contextlib.suppress(OSError, subprocess.TimeoutExpired):  # a container has no modprobe
        subprocess.run(command, capture_output=True, timeout=_MODPROBE_SECONDS, check=False)


def foreign_translations(namespace: Namespace) -> tuple[str, ...]:
    return _foreign(namespace, "nat", lambda table: table.translating())


def foreign_forward_drops(namespace: Namespace) -> tuple[str, ...]:
    """Return chains that drop forwarded packets."""
    return _foreign(namespace, "filter", lambda table: table.chains_that_drop("FORWARD"))


def _foreign(namespace: Namespace, name: str, look: "Callable[[_Table], list[str]]") -> tuple[str, ...]:
    found: list[str] = []
    _in_used_tables(namespace, name, lambda table: found.extend(look(table)))
    return tuple(found)


def _in_used_tables(namespace: Namespace, name: str, work: "Callable[[_Table], None]") -> None:
    def inside() -> None:
        used = [family for family in _families() if name in _tables_in_use(family)]
        if used:
            with _ONE_AT_A_TIME, _xtables_lock():
                for family in used:
                    with _open(family, name) as table:
                        work(table)

    namespace.run(inside)


def _tables_in_use(family: Family) -> list[str]:
    names = "ip6_tables_names" if family == 6 else "ip_tables_names"
    try:
        return Path("/proc/thread-self/net", names).read_text(encoding="ascii").split()
    except FileNotFoundError:
        return []


def render_rule(rule: PacketRule) -> list[RenderedRule]:
    return [
        RenderedRule(rule.chain.value, family, _header(rule), _matches(rule, family), _target(rule))
        for family in rule.families()
    ]


def _header(rule: PacketRule) -> HeaderMatch:
    return HeaderMatch(
        _protocol(rule),
        _interface(rule.arrives_on),
        _interface(rule.leaves_on),
        rule.source,
        rule.destination,
    )


def _protocol(rule: PacketRule) -> str | None:
    if rule.udp_ports is not None:
        return "udp"
    return "tcp" if rule.is_tcp else None


def _matches(rule: PacketRule, family: Family) -> tuple[Extension, ...]:
    tcp: list[tuple[str, str | tuple[str, ...]]] = []
    if rule.tcp_ports is not None:
        tcp.append(("dport", str(rule.tcp_ports).replace("-", ":")))
    if rule.from_ports is not None:
        tcp.append(("sport", str(rule.from_ports).replace("-", ":")))
    if rule.opening or rule.accepting:
        tcp.append(("tcp-flags", ("SYN,ACK", "SYN" if rule.opening else "SYN,ACK")))
    matches: list[Extension] = [("tcp", tuple(tcp))] if tcp else []
    if rule.udp_ports is not None:
        matches.append(("udp", (("dport", str(rule.udp_ports).replace("-", ":")),)))
    if rule.uid is not None:
        matches.append(("owner", (("uid-owner", str(rule.uid)),)))
    if rule.clear_text:
        direction = "out" if rule.chain is Chain.OUT else "in"
        matches.append(("policy", (("dir", direction), ("pol", "none"))))
    ends = (("dst-type", rule.local_destination), ("src-type", rule.local_source))
    if local := tuple((name, "LOCAL") for name, is_matched in ends if is_matched):
        matches.append(("addrtype", local))
    matches += _tracking(rule)
    if rule.distant:
        name, below = ("hl", "hl-lt") if family == 6 else ("ttl", "ttl-lt")
        matches.append((name, ((below, "255"),)))
    if rule.above is not None:
        matches.append(("hashlimit", _hashlimit(rule.above.per_second, rule.above.burst)))
    return (*matches, ("comment", (("comment", rule.purpose),)))


def _tracking(rule: PacketRule) -> list[Extension]:
    matches: list[Extension] = []
    if rule.new_connection:
        matches.append(("conntrack", (("ctstate", "NEW"),)))
    if rule.unknown:
        matches.append(("conntrack", (("ctstate", "NEW,INVALID,UNTRACKED"),)))
    if rule.answered:
        matches.append(("conntrack", (("ctstatus", "ASSURED"), ("ctdir", "ORIGINAL"))))
        matches.append(("connmark", (("mark", f"0x0/{COUNTED_MARK:#x}"),)))
    if rule.translated:
        matches.append(("conntrack", (("ctstate", "DNAT"),)))
    return matches


def _hashlimit(per_second: int, burst: int) -> tuple[tuple[str, str], ...]:
    return (
        ("hashlimit-above", f"{per_second}/sec"),
        ("hashlimit-burst", str(burst)),
        ("hashlimit-mode", "srcip"),
        ("hashlimit-name", f"rosrv-{per_second}-{burst}"),
        ("hashlimit-htable-expire", str(_EXPIRE_MILLISECONDS)),
    )


def _target(rule: PacketRule) -> Extension:
    if rule.verdict is PacketVerdict.RESET:
        return ("REJECT", (("reject-with", "tcp-reset"),))
    if rule.verdict is PacketVerdict.COUNTED:
        return ("CONNMARK", (("or-mark", f"{COUNTED_MARK:#x}"),))
    return (rule.verdict.value, ())


def _interface(interface: Interface | None) -> str | None:
    if interface is None:
        return None
    return f"!{interface.name}" if interface.other else interface.name


class _Table:
    """A table, opened in the namespace of the thread."""

    def __init__(self, library: ModuleType, table: "iptc.Table", family: Family) -> None:
        self._library = library
        self._table = table
        self._family = family

    def replace(self, all_rules: list[RenderedRule], chains: tuple[Chain, ...]) -> None:
        rules = [rule for rule in all_rules if rule.family == self._family]
        present = {chain for chain in chains if self._table.is_chain(chain.value)}
        wanted = {chain for chain in chains if any(rule.chain == chain for rule in rules)}
        for chain in present:
            self._unhook(chain)
            self._table.flush_entries(chain.value)
        for chain in present - wanted:
            self._table.delete_chain(chain.value)
        for chain in wanted - present:
            self._table.create_chain(chain.value)
        for rule in rules:
            self._table.append_entry(rule.chain, self._build(rule).rule)
        for chain in wanted:
            for hook in HOOKS[chain]:
                self._table.insert_entry(hook.place, self._jump(chain).rule, 0)
        if present or wanted:
            self._table.commit()

    def counters(self, chains: tuple[Chain, ...]) -> list[RuleCounter]:
        return [
            self._counter(chain, rule)
            for chain in chains
            if self._table.is_chain(chain.value)
            and all(self._hooks(chain, hook.place) for hook in HOOKS[chain])
            for rule in self._library.Chain(self._table, chain.value).rules
        ]

    def translating(self) -> list[str]:
        chains = [str(chain.name) for chain in self._table.chains]
        return [self._named(name) for name in chains if self._targets(name) & SOURCE_TRANSLATIONS]

    def chains_that_drop(self, chain: str) -> list[str]:
        drops = self._library.Chain(self._table, chain).get_policy().name == "DROP"
        return [self._named(chain)] if drops else []

    def _named(self, chain: str) -> str:
        program = "ip6tables" if self._family == 6 else "iptables"
        return f"{program}-legacy chain {self._table.name} {chain}"

    def _targets(self, chain: str) -> set[str]:
        found, entry = set(), self._table.first_rule(chain)
        while entry:
            found.add(self._table.get_target(entry).decode())
            entry = self._table.next_rule(entry)
        return found

    def _counter(self, chain: Chain, rule: "iptc.Rule") -> RuleCounter:
        packets, octets = rule.get_counters()
        return RuleCounter(chain.value, self._family, _comment(rule), packets, octets)

    def _unhook(self, chain: Chain) -> None:
        for hook in HOOKS[chain]:
            for _ in range(self._hooks(chain, hook.place)):
                jump = self._jump(chain)
                self._table.delete_entry(hook.place, jump.rule, jump.mask)

    def _hooks(self, chain: Chain, hook: str) -> int:
        count, entry = 0, self._table.first_rule(hook)
        while entry:
            count += self._table.get_target(entry) == chain.value.encode()
            entry = self._table.next_rule(entry)
        return count

    def _jump(self, chain: Chain) -> "iptc.Rule":
        return self._build(RenderedRule("", self._family, HeaderMatch(), (), (chain.value, ())))

    def _build(self, rendered: RenderedRule) -> "iptc.Rule":
        rule = self._library.Rule6() if rendered.family == 6 else self._library.Rule()
        header = rendered.header
        if header.protocol is not None:
            rule.protocol = header.protocol
        if header.in_interface is not None:
            rule.in_interface = header.in_interface
        if header.out_interface is not None:
            rule.out_interface = header.out_interface
        if header.source is not None:
            rule.src = header.source
        if header.destination is not None:
            rule.dst = header.destination
        for make, (name, parameters) in (
            *((rule.create_match, match) for match in rendered.matches),
            (rule.create_target, rendered.target),
        ):
            try:
                extension = make(name)
                for parameter, value in parameters:
                    extension.set_parameter(parameter, list(value) if isinstance(value, tuple) else value)
            except self._library.XTablesError as error:
                raise BackendMissingError(f"iptables lacks the extension {name!r}: {error}") from error
        return rule


def _comment(rule: "iptc.Rule") -> str:
    """Return a rule's comment; the library's own function would redirect our standard output."""
    for match in rule.matches:
        if match.name == "comment":
            content = bytes(match.match_buf)[_MATCH_HEADER:]
            return content.partition(b"\0")[0].decode(errors="replace")
    return ""


@contextlib.contextmanager
def _open(family: Family, name: str = "filter") -> Iterator[_Table]:
    library = _library()
    program = "ip6tables" if family == 6 else "iptables"
    table = None
    try:
        table = (library.Table6 if family == 6 else library.Table)(name, autocommit=False)
        table.refresh()
        yield _Table(library, table, family)
    except library.IPTCError as error:
        message = str(error)
        if table is None or "initialize" in message:
            raise BackendMissingError(
                f"the kernel has no {program} table {name} ({message}): modprobe {program[:-1]}_{name}, "
                "CAP_NET_ADMIN and CAP_NET_RAW are needed; or choose the back end nft"
            ) from error
        raise FirewallError(f"{program} rejected the rules in table {name}: {message}") from error
    finally:
        if table is not None:
            table.close()
            type(table)._cache.pop(name, None)  # the cached table is bound to this namespace


def _library() -> ModuleType:
    try:
        with warnings.catch_warnings(action="ignore"):  # its sources are for an older Python
            import iptc  # noqa: PLC0415 - loading it looks for the C libraries, which a machine may lack
    except ModuleNotFoundError as error:
        raise BackendMissingError(
            "the firewall back end iptables needs Python's package python-iptables (module iptc): run scripts/setup in"
            " a checkout, or install the wheel with its extra [iptables]"
        ) from error
    except Exception as error:  # the library raises plain `Exception` if a C library is missing
        raise BackendMissingError(
            f"the firewall back end iptables needs libiptc and xtables: sudo apt install iptables ({error})"
        ) from error
    library: ModuleType = iptc
    return library


def _families() -> tuple[Family, ...]:
    return (4, 6) if Path("/proc/sys/net/ipv6").exists() else (4,)


@contextlib.contextmanager
def _xtables_lock() -> Iterator[None]:
    try:
        lock = os.open(LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise BackendMissingError(
            f"{LOCK}: {error.strerror}: the lock of iptables (a tmpfs on /run?)"
        ) from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        os.close(lock)
