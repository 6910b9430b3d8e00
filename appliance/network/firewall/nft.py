"""The nftables back end: libnftables' JSON through `nft -j -f -`, in one transaction.

Other tables than the appliance's `inet rosrv` can only refuse more packets. A limit per host uses a set of
limited size with one bucket for each host. A rule that adds to a full set does not match, so a second rule gives
all hosts without a bucket one shared bucket.
"""

import json
from dataclasses import replace
from functools import partial
from typing import Any

from appliance.network.firewall.backend import BackendMissingError, FirewallError, RuleCounter
from appliance.network.firewall.firewall_rules import (
    COUNTED_MARK,
    HOOKS,
    SOURCE_TRANSLATIONS,
    Chain,
    Family,
    Hook,
    Interface,
    PacketRule,
    PacketVerdict,
    PortRange,
    RateLimit,
)
from appliance.network.hang_detection import run_program
from appliance.network.namespaces import Namespace

TABLE = "rosrv"
_FAMILY = "inet"
_METER_SIZE = 65535  # hosts
_METER_SECONDS = 60
_OF_A_FAMILY = (PacketVerdict.DNAT, PacketVerdict.KEEP_SOURCE, PacketVerdict.FULL_HOPS)
_FULL_HOPS = 255
_SHARED = " (no bucket left)"  # ends the comment of the second rule, after the purpose

Json = dict[str, Any]
_MARK: Json = {"ct": {"key": "mark"}}


class NftBackend:
    """The rules of one namespace in nftables."""

    name = "nft"
    families: tuple[Family, ...] = (4, 6)  # an `inet` table has both

    def __init__(self, namespace: Namespace, table: str = TABLE) -> None:
        self._namespace = namespace
        self._table = table

    def install(self, rules: tuple[PacketRule, ...]) -> None:
        self._run([*self._delete_table(), self._of_table("add"), *render(rules, self._table)])

    def remove(self) -> None:
        self._run(self._delete_table())

    def counters(self) -> tuple[RuleCounter, ...]:
        tables = self._list("table", "list", "tables")
        if (_FAMILY, self._table) not in [(table.get("family"), table.get("name")) for table in tables]:
            return ()
        rules = self._list("rule", "list", "table", _FAMILY, self._table)
        hooked = {part["jump"]["target"] for rule in rules for part in rule["expr"] if "jump" in part}
        return _counters([rule for rule in rules if rule["chain"] in hooked])

    def foreign_forward_drops(self) -> tuple[str, ...]:
        return tuple(
            f"nftables chain {chain['family']} {chain['table']} {chain['name']}"
            for chain in self._list("chain", "list", "chains")
            if chain.get("hook") == "forward" and chain.get("policy") == "drop"
        )

    def foreign_translations(self) -> tuple[str, ...]:
        rules = self._list("rule", "list", "ruleset")
        found = (
            f"nftables chain {rule['family']} {rule['table']} {rule['chain']}"
            for rule in rules
            if not (rule["family"] == _FAMILY and rule["table"] == TABLE) and _translates_source(rule)
        )
        return tuple(dict.fromkeys(found))

    def _run(self, commands: list[Json]) -> None:
        self._nft(["-f", "-"], json.dumps({"nftables": commands}))

    def _delete_table(self) -> list[Json]:
        """Return commands that delete the table; adding it first is not an error, even if it exists."""
        return [self._of_table("add"), self._of_table("delete")]

    def _of_table(self, verb: str) -> Json:
        return {verb: {"table": {"family": _FAMILY, "name": self._table}}}

    def _list(self, kind: str, *arguments: str) -> list[Json]:
        text = self._nft(list(arguments), "")
        try:
            return [entry[kind] for entry in json.loads(text)["nftables"] if kind in entry]
        except json.JSONDecodeError as error:
            raise FirewallError(f"nft {' '.join(arguments)}: the answer is not JSON: {error}") from error
        except (KeyError, TypeError) as error:
            reason = f"the answer has an unknown format: {_first_lines(text)}"
            raise FirewallError(f"nft {' '.join(arguments)}: {reason}") from error

    def _nft(self, arguments: list[str], text: str) -> str:
        nft = partial(self._namespace.popen, ["nft", "-j", *arguments])
        try:
            status, out, err = run_program(nft, text, "nft")
        except FileNotFoundError:
            raise BackendMissingError(
                "the firewall back end nft needs the program `nft`: sudo apt install nftables"
            ) from None
        except TimeoutError as error:
            raise FirewallError(str(error)) from None
        except OSError as error:
            raise FirewallError(
                f"nft cannot be run: {error.strerror}; check `nft list tables` as root"
            ) from error
        if status != 0:
            reason = _first_lines(err or out)
            raise FirewallError(f"nft rejected the rules in {self._namespace.name}: {reason}")
        return out


def render(rules: tuple[PacketRule, ...], table: str = TABLE) -> list[Json]:
    chains = [chain for chain in Chain if any(rule.chain is chain for rule in rules)]
    limits = sorted({_meter(rule, family) for rule in rules if rule.above for family in rule.families()})
    commands = [
        *(_add("set", _meter_set(name)) for name in limits),
        *(command for rule in rules if rule.seconds is not None for command in _timed_port(rule)),
        *(_add("chain", {"name": chain.value}) for chain in chains),
        *(command for chain in chains for hook in HOOKS[chain] for command in _hook(chain, hook)),
        *(_add("rule", body) for rule in rules for body in render_rule(rule)),
    ]
    for command in commands:
        for body in command["add"].values():
            body["table"] = table
    return commands


def render_rule(rule: PacketRule) -> list[Json]:
    same = rule.above is None and not rule.distant and rule.verdict not in _OF_A_FAMILY
    if same and len(rule.families()) == 2:
        return [_body(rule, [], None)]
    bodies = [_body(rule, [_match(_meta("nfproto"), f"ipv{family}")], family) for family in rule.families()]
    if rule.above is None:
        return bodies
    return [
        rendered
        for body, family in zip(bodies, rule.families(), strict=True)
        for rendered in (body, _shared(rule, body, family))
    ]


def _transport(rule: PacketRule) -> list[Json]:
    expressions: list[Json] = []
    for transport, ports in (("tcp", rule.tcp_ports), ("udp", rule.udp_ports)):
        if ports is not None:
            wanted = _ports(ports) if rule.seconds is None else f"@{_timed_set(rule)}"
            expressions.append(_match(_payload(transport, "dport"), wanted))
    if rule.from_ports is not None:
        expressions.append(_match(_payload("tcp", "sport"), _ports(rule.from_ports)))
    if rule.opening or rule.accepting:
        flags = {"&": [_payload("tcp", "flags"), {"|": ["syn", "ack"]}]}
        expressions.append(_match(flags, "syn" if rule.opening else {"|": ["syn", "ack"]}))
    return expressions


def _body(rule: PacketRule, head: list[Json], family: int | None) -> Json:
    protocol = "ip6" if family == 6 else "ip"
    expressions = list(head)
    for key, interface in (("iifname", rule.arrives_on), ("oifname", rule.leaves_on)):
        if interface is not None:
            expressions.append(_interface(key, interface))
    for field, network in (("saddr", rule.source), ("daddr", rule.destination)):
        if network is not None:
            expressions.append(_match(_payload(protocol, field), _network(network)))
    expressions += _transport(rule)
    if rule.uid is not None:
        expressions.append(_match(_meta("skuid"), rule.uid))
    if rule.clear_text:
        through: Json = {"rt": {"key": "ipsec"}} if rule.chain is Chain.OUT else _meta("ipsec")
        expressions.append(_match(through, False))
    expressions += [*_origin(rule, protocol), *_tracking(rule)]
    if rule.above is not None:
        expressions.append(_over_limit(rule, protocol))
    expressions += [{"counter": None}, _verdict(rule, protocol)]
    return {"chain": rule.chain.value, "expr": expressions, "comment": rule.purpose}


def _origin(rule: PacketRule, protocol: str) -> list[Json]:
    expressions: list[Json] = []
    if rule.local_destination:
        expressions.append(_match({"fib": {"result": "type", "flags": ["daddr"]}}, "local"))
    if rule.local_source:
        expressions.append(_match({"fib": {"result": "type", "flags": ["saddr"]}}, "local"))
    if rule.forwarded is not None:  # local packets have no input interface
        expressions.append(_match(_meta("iif"), 0, "!=" if rule.forwarded else "=="))
    if rule.distant:
        expressions.append(_match(_hops(protocol), _FULL_HOPS, "!="))
    return expressions


def _tracking(rule: PacketRule) -> list[Json]:
    expressions: list[Json] = []
    if rule.new_connection:
        expressions.append(_match({"ct": {"key": "state"}}, "new", "in"))
    if rule.unknown:
        expressions.append(_match({"ct": {"key": "state"}}, {"|": ["established", "related"]}, "!"))
    if rule.answered:
        expressions += [
            _match({"ct": {"key": "status"}}, "assured", "in"),
            _match({"ct": {"key": "direction"}}, "original"),
            _match({"&": [_MARK, COUNTED_MARK]}, 0),
        ]
    if rule.translated:
        expressions.append(_match({"ct": {"key": "status"}}, "dnat", "in"))
    return expressions


def _verdict(rule: PacketRule, protocol: str) -> Json:
    if rule.verdict is PacketVerdict.RESET:
        return {"reject": {"type": "tcp reset"}}
    if rule.verdict is PacketVerdict.DNAT:
        return {"dnat": {"family": protocol, "addr": rule.to}}
    if rule.verdict is PacketVerdict.KEEP_SOURCE:
        return {"snat": {"family": protocol, "addr": _payload(protocol, "saddr")}}
    if rule.verdict is PacketVerdict.FULL_HOPS:
        return {"mangle": {"key": _hops(protocol), "value": _FULL_HOPS}}
    if rule.verdict is PacketVerdict.COUNTED:
        return {"mangle": {"key": _MARK, "value": {"|": [_MARK, COUNTED_MARK]}}}
    return {rule.verdict.value.lower(): None}


def _over_limit(rule: PacketRule, protocol: str) -> Json:
    assert rule.above is not None  # noqa: S101 - the caller asked
    name = _meter(rule, 6 if protocol == "ip6" else 4)
    element = _payload(protocol, "saddr")
    return {"set": {"op": "add", "elem": element, "set": f"@{name}", "stmt": [_limit(rule.above)]}}


def _shared(rule: PacketRule, own: Json, family: Family) -> Json:
    assert rule.above is not None  # noqa: S101 - the caller asked
    address = _payload("ip6" if family == 6 else "ip", "saddr")
    expressions: list[Json] = []
    for expression in own["expr"]:
        if "set" in expression:
            expressions += [_match(address, f"@{_meter(rule, family)}", "!="), _limit(rule.above)]
        else:
            expressions.append(expression)
    return own | {"expr": expressions, "comment": own["comment"] + _SHARED}


def _limit(above: RateLimit) -> Json:
    return {"limit": {"rate": above.per_second, "burst": above.burst, "per": "second", "inv": True}}


def _meter(rule: PacketRule, family: int) -> str:
    assert rule.above is not None  # noqa: S101 - the caller asked
    return f"new-ipv{family}-{rule.above.per_second}-{rule.above.burst}"


def _meter_set(name: str) -> Json:
    kind = "ipv6_addr" if name.startswith("new-ipv6") else "ipv4_addr"
    return {"name": name, "type": kind, "flags": ["timeout"], "timeout": _METER_SECONDS, "size": _METER_SIZE}


def _hook(chain: Chain, hook: Hook) -> list[Json]:
    base = {
        "name": f"{chain.value}-{hook.place}",
        "type": hook.kind,
        "hook": hook.place.lower(),
        "prio": hook.priority,
        "policy": "accept",
    }
    return [
        _add("chain", base),
        _add("rule", {"chain": base["name"], "expr": [{"jump": {"target": chain.value}}]}),
    ]


def _timed_port(rule: PacketRule) -> list[Json]:
    """Return the set of the rule's port, from which the kernel removes it when its time is over."""
    assert rule.tcp_ports is not None  # noqa: S101  checked by `PacketRule`
    name = _timed_set(rule)
    port = {"elem": {"val": rule.tcp_ports.first, "timeout": rule.seconds}}
    return [
        _add("set", {"name": name, "type": "inet_service", "flags": ["timeout"]}),
        _add("element", {"name": name, "elem": [port]}),
    ]


def _timed_set(rule: PacketRule) -> str:
    return f"tcp-{rule.tcp_ports}-for-{rule.seconds}"


def _add(kind: str, body: Json) -> Json:
    return {"add": {kind: {"family": _FAMILY, "table": TABLE, **body}}}


def _match(left: Json, right: object, operator: str = "==") -> Json:
    return {"match": {"op": operator, "left": left, "right": right}}


def _meta(key: str) -> Json:
    return {"meta": {"key": key}}


def _payload(protocol: str, field: str) -> Json:
    return {"payload": {"protocol": protocol, "field": field}}


def _hops(protocol: str) -> Json:
    return _payload(protocol, "hoplimit" if protocol == "ip6" else "ttl")


def _interface(key: str, interface: Interface) -> Json:
    return _match(_meta(key), interface.name, "!=" if interface.other else "==")


def _network(network: str) -> object:
    address, slash, length = network.partition("/")
    return {"prefix": {"addr": address, "len": int(length)}} if slash else address


def _ports(ports: PortRange) -> object:
    return ports.first if ports.first == ports.last else {"range": [ports.first, ports.last]}


def _translates_source(rule: Json) -> bool:
    return any(
        "masquerade" in part or "snat" in part or part.get("xt", {}).get("name") in SOURCE_TRANSLATIONS
        for part in rule["expr"]
        if isinstance(part, dict)
    )


def _counters(rules: list[Json]) -> tuple[RuleCounter, ...]:
    shared = {_key(counter): counter for counter in map(_counter, rules) if counter.purpose.endswith(_SHARED)}
    counters = []
    for rule in rules:
        counter = _counter(rule)
        if any("set" in part for part in rule["expr"]):
            behind = shared.get(_key(replace(counter, purpose=counter.purpose + _SHARED)))
            if behind is None:
                continue
            packets, octets = counter.packets + behind.packets, counter.octets + behind.octets
            counter = replace(counter, packets=packets, octets=octets)
        if _key(counter) not in shared:
            counters.append(counter)
    return tuple(counters)


def _key(counter: RuleCounter) -> tuple[str, Family | None, str]:
    return counter.chain, counter.family, counter.purpose


def _counter(rule: Json) -> RuleCounter:
    count: Json = next((part["counter"] for part in rule["expr"] if "counter" in part), {})
    families = [
        part["match"]["right"]
        for part in rule["expr"]
        if "match" in part and part["match"]["left"] == _meta("nfproto")
    ]
    return RuleCounter(
        chain=rule["chain"],
        family=None if not families else 6 if families[0] == "ipv6" else 4,
        purpose=rule.get("comment", ""),
        packets=count.get("packets", 0),
        octets=count.get("bytes", 0),
    )


def _first_lines(text: str) -> str:
    return " ".join(text.split())[:600] or "no reason given"
