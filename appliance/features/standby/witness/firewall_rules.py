"""The rules of the robot's firewall, for `nft` and for `iptables`. No I/O."""

from typing import Dict, List

from appliance.features.standby.witness.protocol import tag_of
from appliance.features.standby.witness.settings import WitnessSettings

TABLE = "rosrv_witness"
CHAINS = "rosrv-witness"
JUMPS = (
    ("filter", (("INPUT", "in"), ("OUTPUT", "out"), ("FORWARD", "forward"))),
    ("nat", (("OUTPUT", "nat"), ("PREROUTING", "nat"))),
    ("raw", (("OUTPUT", "raw"),)),
)
MARK = 0x72777431  # of the witness's own segments, which the connection tracker must not see
_TUNNEL_PORTS = (500, 4500)


def nft_rules(settings: WitnessSettings, admitted: str) -> str:
    """Return the rules that admit one appliance. They also drop requests without the tag of the sender's key."""
    names = sorted(settings.appliances)
    control = "{ %s }" % ", ".join(map(str, (*_TUNNEL_PORTS, settings.listen[1])))
    local = 'iif "lo" ip daddr %s udp dport %d drop' % settings.listen  # no appliance is on this computer
    translate, arriving, leaving = [], [local, 'iif "lo" accept'], []  # type: List[str], List[str], List[str]
    for name in names:
        address = settings.appliances[name].address
        if name == admitted:
            ports = ", ".join(settings.ports)
            translate.append("ip daddr %s tcp dport { %s } dnat to %s" % (settings.fixed, ports, address))
            continue
        for rules, side, port in ((arriving, "saddr", "dport"), (leaving, "daddr", "sport")):
            match = "ip %s %s" % (side, address)
            rules += [
                "%s udp %s %s accept" % (match, port, control),
                "%s udp %s %s accept" % (match, "dport" if port == "sport" else "sport", control),
                "%s ip protocol { icmp, esp } accept" % match,
                "%s tcp flags & rst == rst accept" % match,
                "%s ip protocol tcp reject with tcp reset" % match,
                "%s drop" % match,
            ]
    followers = [settings.followers[name].address for name in sorted(settings.followers)]
    addresses = ", ".join([settings.appliances[name].address for name in names] + followers)
    request = "ip daddr %s udp dport %d" % settings.listen  # at other addresses, the port is that of DDS
    requests = ["%s ip saddr != { %s } drop" % (request, addresses)]
    requests += [
        "%s ip saddr %s @th,64,32 != 0x%s drop" % (request, peer.address, tag_of(peer.key).hex())
        for _name, peer in sorted({**settings.appliances, **settings.followers}.items())
        if peer.key  # a follower has no keys of the appliances
    ]
    leaving += [
        "ip daddr %s ip protocol tcp reject with tcp reset" % settings.fixed,
        "ip daddr %s drop" % settings.fixed,
    ]
    chains = (
        ("untracked", "filter hook output priority -300", ["meta mark %d notrack" % MARK]),
        ("translate_own", "nat hook output priority -100", translate),
        ("translate_others", "nat hook prerouting priority -100", translate),
        ("arriving", "filter hook input priority 0", arriving + requests),
        ("leaving", "filter hook output priority 0", leaving),
        ("forwarded", "filter hook forward priority 0", arriving[2:] + leaving),
    )
    return "table ip %s\ndelete table ip %s\ntable ip %s {\n%s}\n" % (
        TABLE,
        TABLE,
        TABLE,
        "".join(
            "    chain %s {\n        type %s; policy accept;\n%s    }\n"
            % (name, hook, "".join("        %s\n" % rule for rule in rules))
            for name, hook, rules in chains
        ),
    )


def iptables_rules(settings: WitnessSettings, admitted: str, present: Dict[str, List[str]]) -> str:
    """Return the input of iptables-restore that admits one appliance.

    The filter comes first: until the translation follows, connections to the fixed address are rejected or go to the
    new holder. Our jump becomes the first rule, before any that accepts established connections.
    """
    names = sorted(settings.appliances)
    control = ",".join(map(str, (*_TUNNEL_PORTS, settings.listen[1])))
    translate, coming, going = [], [], []  # type: List[str], List[str], List[str]
    reset = "-p tcp -j REJECT --reject-with tcp-reset"
    for name in names:
        address = settings.appliances[name].address
        if name == admitted:
            translate += [
                "-d %s -p tcp --dport %s -j DNAT --to-destination %s"
                % (settings.fixed, ports.replace("-", ":"), address)
                for ports in settings.ports
            ]
            continue
        for rules, side in ((coming, "-s"), (going, "-d")):
            rules += ["%s %s %s" % (side, address, rule) for rule in _passing(control)]
            rules += ["%s %s %s" % (side, address, reset), "%s %s -j DROP" % (side, address)]
    going += ["-d %s %s" % (settings.fixed, reset), "-d %s -j DROP" % settings.fixed]
    peers = [settings.appliances[name].address for name in names]
    peers += [settings.followers[name].address for name in sorted(settings.followers)]
    requests = ["-s %s -j RETURN" % peer for peer in peers]
    requests.append("-d %s -p udp --dport %d -j DROP" % settings.listen)
    chains = {
        "in": [
            "-i lo -d %s -p udp --dport %d -j DROP" % settings.listen,
            "-i lo -j RETURN",
            *coming,
            *requests,
        ],
        "out": going,
        "forward": coming + going,
        "nat": translate,
        "raw": ["-m mark --mark %d -j CT --notrack" % MARK],
    }
    lines = []  # type: List[str]
    for table, jumps in JUMPS:
        own = sorted({name for _, name in jumps})
        lines.append("*" + table)
        lines += [":%s-%s - [0:0]" % (CHAINS, name) for name in own]
        lines += ["-A %s-%s %s" % (CHAINS, name, rule) for name in own for rule in chains[name]]
        for chain, name in jumps:
            jump = "%s -j %s-%s" % (chain, CHAINS, name)
            rules = present.get("%s %s" % (table, chain), [])
            if rules[:1] != ["-A " + jump]:
                lines += ["-D " + jump] * rules.count("-A " + jump)
                lines.append("-I " + jump)
        lines.append("COMMIT")
    return "\n".join(lines) + "\n"


def _passing(control: str) -> List[str]:
    ports = ["-p udp -m multiport --%ss %s -j RETURN" % (side, control) for side in ("dport", "sport")]
    return [*ports, "-p icmp -j RETURN", "-p esp -j RETURN", "-p tcp --tcp-flags RST RST -j RETURN"]


def without_iptables_rules(saved: str) -> str:
    lines, own = [], []  # type: List[str], List[str]
    for line in saved.splitlines():
        if line.startswith("*"):
            lines.append(line)
        elif line.startswith(":%s-" % CHAINS):
            own.append(line[1:].split()[0])
        elif (
            line.startswith("-A ")
            and line.split()[-1].startswith(CHAINS + "-")
            and line.split()[1] not in own
        ):
            lines.append(line.replace("-A", "-D", 1))
        elif line == "COMMIT":
            lines += ["-F " + chain for chain in own] + ["-X " + chain for chain in own] + [line]
            own = []
    return "\n".join(lines) + "\n"
