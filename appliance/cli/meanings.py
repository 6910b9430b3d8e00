"""The meanings of words that `rosrv` does not have as commands: habits of systemctl, ufw, docker, kubectl, ROS, git.

An answer names a command with an effect only for a word that means this effect. Likeness of letters proposes
`READING` alone: `reload` is like `release`, which takes the protection away.
"""

import re
from difflib import get_close_matches
from pathlib import Path

from appliance.cli.verb_table import Group, Verbs
from appliance.network.namespaces import is_contained

MEANINGS = {
    "log logs logging event events tail tailf trail journal journalctl follow dmesg trace": "audit tail",
    "history search find grep query since violation": "audit search",
    "stats summary denials denied attack threat intrusion": "audit summary",
    "why reason debug": "audit why, policy explain",
    "incident incidents": "audit search, record list",
    "integrity tamper": "audit verify",
    "compliance": "report interventions",
    "ps health healthcheck info stat state top uptime ping ready alive heartbeat net daemon uri url": "status",
    "is-active is-enabled is-failed units collector system components clock time ntp latency": "status",
    "watch wait": "status --watch, audit tail",
    "netcheck master roscore rosmaster": "status, survey",
    "switch": "standby status, policy revisions",
    "rotate": "token list, limits",
    "repair doctor diagnose diagnostics diag wtf bugreport support fix recover rescue": "selftest, status",
    "test simulate dry-run dryrun": "selftest, policy test",
    "about license changelog": "version",
    "list ls get show describe inspect cat view dump all": "status, topic list, node list, host list",
    "block ban banip deny drop reject forbid blacklist quarantine isolate cordon kick eject blackhole": "host block",
    "unblock unban unbanip uncordon": "host unblock",
    "blocked banned bans blacklisted jail jails": "host blocks",
    "allow permit accept authorize authorise whitelist chmod addignoreip": "policy grant",
    "rule rules ruleset acl acls policies perms permissions permission chain chains table tables rbac": "policy show",
    "firewall iptables nft nftables ufw": "policy show, host blocks",
    "rights right grants privileges security default group permissive": "policy show, host blocks",
    "network networks route routes port ports nat interfaces": "survey, status",
    "can can-i whocan auth may access": "policy explain, policy who-may",
    "who whois last": "who-drove, policy who-may",
    "reload daemon-reload apply refresh sync syncconf hup": "policy reload, monitor reload, host reload",
    "lint validate syntax compile": "policy check, monitor check, config check",
    "undo revert checkout": "policy rollback, monitor rollback",
    "commit keep": "policy confirm, monitor confirm",
    "blame changes": "report interventions, policy revisions",
    "topics rostopic sub subscribe action actions map tf camera": "topic list, topic echo",
    "hz bw delay rate type subscribers bandwidth throughput traffic": "topic info",
    "sniff tcpdump capture": "topic echo",
    "nodes rosnode lifecycle processes container containers": "node list",
    "peers peer inventory machines machine clients devices endpoints pods ip addr": "host list",
    "address connections netstat ss sockets lsof trust": "host list",
    "service services rosservice interface scan discover nmap graph rqt_graph robot robots": "survey",
    "bag rosbag snapshot": "record list, record now",
    "recording blackbox video": "record list",
    "play": "monitor replay",
    "configure settings conf showconf getconf setting env environment webhook": "config show",
    "email syslog siem telemetry": "config show",
    "cert certs ca tls ssl fingerprint pubkey": "certificate",
    "adduser useradd login signin sign-in": "token add",
    "user account passwd password key apikey role operator session logout": "token list, sso list",
    "oidc oauth ldap mfa totp saml": "sso list",
    "whoami iam sts get-caller-identity": "token list",
    "enroll enrol register onboard vpn ipsec tunnel wireguard wg genkey": "host list, host add",
    "join": "host add, standby join, fleet join",
    "pair": "standby status, standby join",
    "ha cluster replica swarm maintenance mirror replicate primary secondary": "standby status",
    "failover failback promote demote switchover": "standby status, standby switch",
    "ticket invite": "door ticket",
    "browser browsers foxglove rviz rosbridge websocket agent agents mcp": "door list",
    "tag tags rollout reflog versions": "policy revisions, monitor revisions",
    "compare": "policy diff, monitor diff",
    "harden lockdown": "protect, policy enforce",
    "speed velocity cmd_vel drivers": "drive status, guard list",
    "control lease teleop joystick override queue priority": "drive status",
    "take takeover give grab handover": "drive status, drive assign",
    "safety watchdog deadman zone fence geofence collision": "guard list, guard suggest",
    "specs spec specification rv": "monitor list",
    "alert alerts warning warnings problems issues errors unmute notify notifications": "alarm list",
    "ack acknowledge": "alarm acknowledge, audit acknowledge",
    "mute snooze": "alarm silence",
    "pending requests approvals ask": "approve",
    "quota quotas limit usage df du memory cpu disk storage volume resources vacuum retention free": "limits",
    "save archive": "backup",
    "wipe factory-reset": "purge",
    "cp download": "record fetch, audit export",
    "man help docs commands": "-h",
    "set": "config show, guard set, monitor set",
    "init setup new quickstart wizard tutorial example": "survey, selftest",
    "metrics prometheus": "limits",
    "ui gui web api rest console dashboard serve open browse": "status",
    "lock unlock": "drive status",
    "renew": "certificate, token list",
}
"""First words with the commands that they mean. Verbs of a group, such as `grant`, need no row."""

REMARKS = {
    "start begin boot poweron": "Start the appliance: {start}.",
    "stop shutdown down quit exit poweroff power-off": "End the appliance: {stop}. {estop}",
    "restart reboot try-restart condrestart": "Restart the appliance: {restart}.",
    "estop e-stop halt freeze emergency emergency-stop stop-robot robot-stop panic brake pause": "{estop}",
    "kill cleanup": "{kill} End the appliance: {stop}.",
    "enable": "Start the appliance at each boot: {enable}. See also `rosrv policy enforce`,"
    " `rosrv monitor enable`, `rosrv guard enforce`.",
    "disable mask": "No start of the appliance at boot: {disable}. For a monitor: `rosrv monitor disable`.",
    "flush reset clear rm del delete clean prune gc": "This program clears nothing as a whole;"
    " what is in force: `rosrv policy show`, `rosrv host blocks`, `rosrv monitor list`.",
    "run exec launch call pub publish rosrun roslaunch attach create build": "This program starts no node and"
    " sends no message: use the tools of ROS.",
    "param params rosparam": "This program reads no parameters: use rosparam.",
    "edit vim vi nano": "Edit the policy's file; then: `rosrv policy check FILE`, `rosrv policy reload`.",
    "set": "Settings are in appliance.yaml.",
    "ssh sh bash shell su sudo": "This program opens no shell.",
    "update upgrade downgrade install uninstall pull images": "Packages and images: docs/install.md of the release.",
    "init setup new quickstart wizard tutorial example": "`rosrv` alone on a terminal proposes the first steps.",
    "metrics prometheus": "Prometheus reads /v1/metrics.",
    "ui gui web api rest console dashboard serve open browse": "The console is at the address of `api`.",
}
"""Remarks on first words. In braces are the keys of `_service`."""

_STOPS = "stop halt freeze brake panic emergency estop e-stop emergency-stop pause"
IN_GROUPS = (
    ("approval", "list ls show approve grant accept allow", "approve", ""),
    (
        "config",
        "set edit reset",
        "config check",
        "Change appliance.yaml, and restart the appliance: {restart}.",
    ),
    ("drive", _STOPS, "", "{estop}"),
    ("fleet", "list ls status info show", "status", ""),
    ("guard", _STOPS, "", "{estop}"),
    ("guard", "disable off deactivate shadow", "monitor disable", ""),
    ("guard", "enable on activate", "guard enforce, monitor enable", ""),
    ("report", "list show generate create print", "report interventions", ""),
    ("topic", "pub publish", "", "This program sends no message: rostopic pub."),
    ("node", "kill stop cleanup", "", "{kill}"),
    (
        "policy",
        "set edit deny revoke remove rm delete",
        "policy check, policy reload",
        "Edit the policy's file first.",
    ),
)
"""Words of a group that the synonyms do not give, with commands and a remark."""

SYNONYMS = (
    "list show info blocks status ls ps get describe inspect cat view dump print all",
    "add new create enroll enrol register make load upload open",
    "remove revoke rm del delete erase unload close",
    "block ban deny drop reject blacklist",
    "unblock unban allow permit whitelist",
    "ask request",
    "grant allow permit accept authorize",
    "reload load apply refresh sync update push deploy",
    "enable enforce on activate start",
    "disable off deactivate stop pause",
    "refuse deny reject",
    "search find grep query filter",
    "tail follow log logs watch events",
    "assign give take grab lock",
    "free release unlock",
    "rollback undo revert",
    "revisions history versions log",
    "confirm commit keep",
    "diff compare changes",
    "switch failover takeover promote",
    "now start snapshot capture",
    "rotate renew refresh",
    "take pull",
    "set edit change",
    "suggest presets types",
    "end logout close revoke",
    "acknowledge ack dismiss",
    "silence mute snooze off",
    "explain why can can-i allowed",
    "fetch download save export",
    "export save dump create collect",
    "verify check validate lint syntax",
    "join pair connect",
    "leave disconnect quit remove",
    "info hz bw delay type find rate",
)
"""Words of one meaning; in a group, they mean those of them that the group has."""

READING = {
    "": "status limits selftest survey version certificate who-drove",
    "alarm": "list",
    "audit": "why search summary tail show verify checkpoints",
    "config": "check show",
    "door": "list",
    "drive": "status",
    "evidence": "verify verifier",
    "guard": "list manual show suggest",
    "host": "blocks list show",
    "monitor": "check coverage diff list replay revisions run show",
    "node": "list",
    "policy": "check diff explain revisions show test unused who-may",
    "record": "list messages show timeline",
    "report": "interventions",
    "sso": "list",
    "standby": "status",
    "token": "list",
    "topic": "echo info list publishers",
}
"""The commands without an effect on the appliance and on the robot, by group."""

_Meant = tuple[list[str], str]  # commands, and a remark


def answer_to(word: str, group: str, verbs: Verbs) -> str:
    """Return the answer to a word that no command of a group has; `group` is empty for the first word."""
    meant, remark = _meant(word.lower().replace("_", "-"), group, verbs)
    said = f"no such command '{f'{group} {word}'.strip()}'"
    if meant:
        names = [f"`rosrv {name}`" for name in meant]
        which = f"{', '.join(names[:-1])} or {names[-1]}" if names[1:] else names[0]
        return f"{said}. Did you mean {which}? {remark}".rstrip()
    if remark:
        return f"{said}. {remark}"
    if not group:
        return f"{said}; `rosrv -h` lists all commands"
    shown = [name for name, verb in verbs.items() if isinstance(verb, Group) or not verb.hidden]
    return f"{said}; use one of: {', '.join(shown)}"


def _meant(word: str, group: str, verbs: Verbs) -> _Meant:
    if group:
        found = _in_group(word, group, verbs)
    else:
        found = _first_word(word, verbs) or _compound(re.split(r"[-_:.]", word), verbs)
    return found or (_alike(word, group, verbs), "")


def _in_group(word: str, group: str, verbs: Verbs) -> _Meant | None:
    for name, words, commands, remark in IN_GROUPS:
        if name == group and word in words.split():
            return _said(commands, remark)
    same = {other for synonyms in SYNONYMS if word in synonyms.split() for other in synonyms.split()}
    if named := [f"{group} {name}" for name in verbs if name in same]:
        return named, ""
    found = (
        [] if _of(word, REMARKS) else _of(word, MEANINGS).split(", ")
    )  # remarks are about the whole appliance
    here = all(name.startswith(f"{group} ") or is_reading(name) for name in found)
    return (found, "") if found != [""] and found and here else None


def _first_word(word: str, verbs: Verbs) -> _Meant | None:
    name = word.removesuffix("s")
    if is_reading(word):  # a part of `swarm-status`
        return [word], ""
    for form in (word, name):
        if found := _said(_of(form, MEANINGS), _of(form, REMARKS)):
            return found
    inner = [
        f"{name} {word}" for name, verb in verbs.items() if isinstance(verb, Group) and word in verb.verbs
    ]
    if not inner and isinstance(group := verbs.get(name), Group):
        inner = [f"{name} list" if "list" in group.verbs else name]
    return (inner, "") if inner else None


def _compound(parts: list[str], verbs: Verbs) -> _Meant | None:
    """Return what `list-hosts`, `host_list` and `halt-robot` mean: the noun counts, and a stop before all others."""
    if not parts[1:]:
        return None
    general = [*SYNONYMS[0].split(), "check"]
    parts = parts[::-1]
    nouns = sorted(parts, key=lambda part: (_of(part, REMARKS) != "{estop}", part in general))
    for noun in nouns:
        name = noun if noun in verbs else noun.removesuffix("s")
        if isinstance(group := verbs.get(name), Group):
            for part in parts:
                if part in group.verbs:
                    return [f"{name} {part}"], ""
                if part != noun and (found := _in_group(part, name, group.verbs)):
                    return found
            return [name], ""
    return next(filter(None, (_first_word(part, verbs) for part in nouns)), None)


def _of(word: str, table: dict[str, str]) -> str:
    return next((meant for words, meant in table.items() if word in words.split()), "")


def _said(commands: str, remark: str) -> _Meant | None:
    if not commands and not remark:
        return None
    return [name for name in commands.split(", ") if name], remark.format(**_service())


def is_reading(command: str) -> bool:
    """Return whether a command, which may have options, has no effect."""
    name = command.partition(" -")[0]
    group, _space, verb = name.rpartition(" ")
    return name == "-h" or verb in READING.get(group, "").split()


def _alike(word: str, group: str, verbs: Verbs) -> list[str]:
    names = {f"{group} {name}".strip(): name for name, verb in verbs.items()}
    harmless = {
        name: full for full, name in names.items() if is_reading(full) or isinstance(verbs[name], Group)
    }
    return [harmless[name] for name in get_close_matches(word, harmless, cutoff=0.8)]


_UNIT = Path("/lib/systemd/system/rosrv.service")  # of the Debian package
_ROBOT = {
    "estop": "This program stops no robot: press its emergency stop.",
    "kill": "This program ends no node: rosnode kill NODE.",
}


def _service() -> dict[str, str]:
    """Return the shell commands of this installation, and the sentences about nodes and motion."""
    orders = ("start", "stop", "restart", "enable", "disable")
    if is_contained():
        compose = {order: f"docker compose {order} appliance" for order in orders}
        return _ROBOT | compose | dict.fromkeys(("enable", "disable"), "`restart:` in compose.yaml")
    if _UNIT.exists():
        return _ROBOT | {order: f"sudo systemctl {order} rosrv" for order in orders}
    up, end, unit = "rosrv up", "Ctrl-C in its terminal", "install the package, docs/install.md"
    return _ROBOT | dict(zip(orders, (up, end, f"{end}, then {up}", unit, unit), strict=True))
