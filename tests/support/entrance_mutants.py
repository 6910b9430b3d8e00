"""Rules that are taken out of the code, by entrance and rule of `entrances.py`: a test of the cell must turn red."""

from typing import NamedTuple


class Without(NamedTuple):
    """A change of a file's source that takes a rule out."""

    file: str
    old: str
    new: str


_POLICY = "appliance/policy/policy.py"
_FIREWALL = "appliance/network/firewall/firewall_rules.py"
_FOLDING = "appliance/audit/log/folding.py"
_ACCESS = "appliance/api/front/access.py"
_SSO = "appliance/features/sso/"
_FLEET = "fleet/rosrv_fleet/"
_NO_FOLDING = Without(
    _FOLDING,
    "        kind = self._kinds.get(key)\n        if kind is not None:\n",
    "        kind = None\n        if kind is not None:\n",
)
_FIRST_COME = Without(
    "appliance/rpc/fair_queue.py",
    "elif self._taken.get(kind, 0) >= self._together or self.slots.take(host):",
    "elif self.slots.total >= self.slots.bounds.whole or self.slots.charge(host):",
)
_STREAMS = "appliance/api/front/streams.py"

WHOLE = ("RVMaster", "node API", "relay", "follower", "sign-on", "collector")
"""The entrances of which every rule with a test has a row here."""

MUTANTS: dict[tuple[str, str], Without] = {
    ("RVMaster", "block"): Without(
        _POLICY,
        "        if denial is not None:\n            return denial\n        category",
        "        category",
    ),
    ("RVMaster", "end of a right"): Without(
        "appliance/master/reconcile/sinks.py", "count = self.revocation.redecide()", "count = 0"
    ),
    ("RVMaster", "unknown"): Without(
        "appliance/control/assembly/listener_limits.py",
        "if not (host.is_loopback or self._policy().standing(host).known):",
        "if False:",
    ),
    ("RVMaster", "folding"): _NO_FOLDING,
    ("RVMaster", "share"): _FIRST_COME,
    ("RVMaster", "binding"): Without(_FIREWALL, "                distant=True,\n", ""),
    ("node API", "block"): Without(
        _POLICY,
        "        if denial is not None:\n            return denial\n        category",
        "        category",
    ),
    ("node API", "end of a right"): Without(
        "appliance/relay/data_plane.py",
        "            self._table.withdraw(message)\n            self._withdrawn(message)\n",
        "            self._table.withdraw(message)\n",
    ),
    ("node API", "unknown"): Without(
        "appliance/rpc/connection_table.py",
        "            if quota_class > mine:\n                return None\n",
        "            return None\n",
    ),
    ("node API", "folding"): _NO_FOLDING,
    ("node API", "share"): _FIRST_COME,
    ("node API", "binding"): Without(_FIREWALL, "        *_own_node(settings),\n", ""),
    ("node API", "failure"): Without(
        "appliance/master/endpoints/delivery.py", "if queue.incarnation.host == host)", "if True)"
    ),
    ("relay", "block"): Without(
        "appliance/relay/data_plane.py",
        "            self._table.withdraw(message)\n            self._withdrawn(message)\n",
        "            self._table.withdraw(message)\n",
    ),
    ("relay", "end of a right"): Without(
        "appliance/relay/data_plane.py",
        "            self._table.withdraw(message)\n            self._withdrawn(message)\n",
        "            self._table.withdraw(message)\n",
    ),
    ("relay", "unknown"): Without(
        "appliance/relay/grant_table.py",
        "return QuotaClass.REGISTERED if host in self._hosts else QuotaClass.UNKNOWN",
        "return QuotaClass.REGISTERED",
    ),
    ("relay", "folding"): Without("appliance/relay/report.py", "if refusal in self._refused:", "if False:"),
    ("relay", "binding"): Without(
        "appliance/relay/grant_table.py",
        'grant = self._facts.get(("grant", key, topic, host, caller_id))',
        'grant = next((one for fact, one in self._facts.items() if fact[:3] == ("grant", key, topic)), None)',
    ),
    ("relay", "failure"): Without(
        "appliance/relay/connections/upstream.py",
        "self._limits.retry_first * 2.0**self.failures",
        "self._limits.retry_first",
    ),
    ("follower", "block"): Without(
        _ACCESS,
        '        if self.is_blocked(peer):\n            return _BLOCKED\n        return ""',
        "        kept",
    ),
    ("follower", "end of a right"): Without(
        _ACCESS,
        "return clock.since_boot() < self._ends.get(token, (0.0, 0.0))[1]",
        "return token in self._ends",
    ),
    ("follower", "share"): Without(_STREAMS, "if self._tokens.refusal(bearer.id):", "if False:"),
    ("follower", "binding"): Without(
        _FIREWALL,
        '        _arriving("REST port: no other network", PacketVerdict.RESET, tcp_ports=ports),\n',
        "",
    ),
    ("sign-on", "end of a right"): Without(
        f"{_SSO}sessions.py",
        "ended = [one for one in own if (one.role, one.groups) != rights]",
        "ended: list[Session] = []",
    ),
    ("sign-on", "unknown"): Without(f"{_SSO}sign_on.py", "if peer_key(one.address) == peer)", "if True)"),
    ("sign-on", "share"): Without(
        f"{_SSO}sessions.py", "        ended += staying[: max(0, len(staying) + 1 - _MOST_OF_PERSON)]\n", ""
    ),
    ("sign-on", "binding"): Without(
        f"{_SSO}sign_on.py", "self._pending.pop(state, None)", "self._pending.get(state)"
    ),
    ("sign-on", "failure"): Without(
        f"{_SSO}provider.py",
        "if self._keys is None or now - self._keys[0] >= self._keys_seconds:",
        "if self._keys is None:",
    ),
    ("collector", "unknown"): Without(
        f"{_FLEET}connections.py",
        "if (full or (not proven and self._others_open >= self._most // 2)) and not",
        "if full and not",
    ),
    ("collector", "share"): Without(
        f"{_FLEET}connections.py",
        "most = max(self._others, key=lambda one: len(self._others[one]), default=None)",
        "most = next(iter(self._others), None)",
    ),
    ("collector", "failure"): Without(
        f"{_FLEET}join_routes.py",
        "        self._sent.append((clock.now(), owner_of(address)))\n",
        "        pass\n",
    ),
    ("relay", "share"): Without(
        "appliance/relay/transport/memory.py", "return bool(self.refusal())", "return not self.plenty"
    ),
    ("follower", "folding"): Without(
        "appliance/api/front/journal.py", "if kind in self._repeated:", "if False:"
    ),
    ("sign-on", "block"): Without(
        _ACCESS, "return bool(self._blocked) and plain_address(peer) in self._blocked", "return False"
    ),
    ("sign-on", "folding"): Without(
        f"{_SSO}orders.py",
        '"sign-on refused", str(error)[:_TEXT], decision="deny"',
        '"sign-on", str(error)[:_TEXT], decision="deny"',
    ),
    ("collector", "end of a right"): Without(
        f"{_FLEET}robots.py",
        "            except EnrolmentError as error:\n                unreadable",
        "            except KeyError as error:\n                unreadable",
    ),
    ("collector", "binding"): Without(
        f"{_FLEET}server.py", "return found if found in self._fingerprints else None", "return found"
    ),
}
