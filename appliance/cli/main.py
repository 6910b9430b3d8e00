"""The `rosrv` command: one app, one module for each verb, imported when it is run (`lazy.py`)."""

import errno
import os
import sys
import traceback
from typing import Annotated

import typer

from appliance import __version__
from appliance.cli.lazy import Group, Verb, application

_CONFIRM = "Keep what was loaded with --confirm-within; exit status 1 when there is nothing to confirm."

VERBS: dict[str, Verb | Group] = {
    "up": Verb("up:up"),
    "status": Verb("status_verb:status"),
    "selftest": Verb("selftest.verb:selftest"),
    "demo": Verb("demo:demo"),
    "protect": Verb("protect_verb:protect", "Close the ROS ports of this machine to all but the appliance."),
    "audit": Group(
        "Review the audit log and prove that it is complete.",
        {
            "why": Verb("policy.grant_verb:why"),
            "search": Verb("audit.audit_verbs:search"),
            "tail": Verb("audit.audit_verbs:tail"),
            "show": Verb("audit.audit_verbs:show"),
            "verify": Verb("audit.audit_verbs:verify"),
            "checkpoints": Verb("audit.audit_verbs:checkpoints"),
            "export": Verb("audit.audit_verbs:export"),
        },
    ),
    "evidence": Group(
        "Evidence: what happened, in one file that proves itself elsewhere.",
        {
            "export": Verb("evidence_verbs:export_evidence"),
            "verify": Verb("evidence_verbs:verify"),
            "verifier": Verb("evidence_verbs:verifier"),
        },
    ),
    "policy": Group(
        "Check, explain, test, compare, learn and change access policies.",
        {
            "learn": Verb("policy.learn_verb:learn_policy"),
            "reload": Verb("policy.live_verbs:reload"),
            "rollback": Verb(
                "policy.live_verbs:rollback", "Bring a kept revision of the policy into force again."
            ),
            "confirm": Verb("policy.live_verbs:confirm", _CONFIRM),
            "revisions": Verb(
                "policy.live_verbs:revisions", "List the kept revisions of the policy, the newest first."
            ),
            "grant": Verb("policy.grant_verb:grant"),
            "check": Verb("policy.policy_verbs:check"),
            "explain": Verb("policy.policy_verbs:explain_request"),
            "test": Verb("policy.policy_verbs:test"),
            "diff": Verb("policy.policy_verbs:compare"),
        },
    ),
    "monitor": Group(
        "Monitors: check specifications, try them on a recording, run them on the robot.",
        {
            "check": Verb("monitor.verbs:check"),
            "run": Verb("monitor.verbs:run"),
            "learn": Verb("monitor.verbs:learn_monitors"),
            "replay": Verb("monitor.replay:replay_monitor"),
            "coverage": Verb("monitor.verbs:coverage"),
            "list": Verb("monitor.in_force:list_monitors"),
            "margins": Verb("monitor.in_force:margins"),
            "enable": Verb("monitor.in_force:enable"),
            "promote": Verb("monitor.in_force:promote"),
            "disable": Verb("monitor.in_force:disable"),
            "load": Verb("monitor.in_force:load"),
            "remove": Verb("monitor.in_force:remove"),
            "reload": Verb("monitor.in_force:reload"),
            "revisions": Verb(
                "monitor.revision_verbs:revisions",
                "List the kept revisions of the specifications, the newest first.",
            ),
            "show": Verb("monitor.revision_verbs:show"),
            "diff": Verb("monitor.revision_verbs:diff"),
            "rollback": Verb(
                "monitor.revision_verbs:rollback",
                "Bring a kept revision of the specifications into force again; what comes back is switched as it was.",
            ),
            "confirm": Verb("monitor.revision_verbs:confirm", _CONFIRM),
            "resume": Verb("monitor.in_force:resume"),
            "reset": Verb("monitor.offline:reset"),
            "rvstate": Verb("monitor.in_force:rv_state", hidden=True),
        },
    ),
    "topic": Group(
        "What is said on the topics of the running robot.",
        {"echo": Verb("topic_verbs:echo"), "info": Verb("topic_verbs:info")},
    ),
    "record": Group(
        "The flight recorder: what was said before and after something happened.",
        {
            "now": Verb("record_verbs:now"),
            "list": Verb("record_verbs:list_recordings"),
            "show": Verb("record_verbs:show"),
            "timeline": Verb("record_verbs:show_timeline"),
            "messages": Verb("record_verbs:messages"),
            "fetch": Verb("record_verbs:fetch"),
            "remove": Verb("record_verbs:remove"),
        },
    ),
    "sign": Verb("sign:sign"),
    "version": Verb("version:version"),
    "config": Group(
        "Check or show the configuration.",
        {"check": Verb("config_verbs:check"), "show": Verb("config_verbs:show")},
    ),
    "host": Group(
        "Enrol, list and revoke hosts that come through IPsec tunnels.",
        {
            "add": Verb("host.host_verbs:add"),
            "kit": Verb("host.host_verbs:kit"),
            "list": Verb("host.host_verbs:list_hosts"),
            "reload": Verb("host.host_verbs:reload"),
            "revoke": Verb("host.host_verbs:revoke"),
        },
    ),
    "backup": Verb("backup:backup"),
    "restore": Verb("backup:restore"),
    "purge": Verb("backup:purge"),
    "token": Group(
        "Make, list and revoke access tokens for REST.",
        {"add": Verb("token:add"), "list": Verb("token:list_tokens"), "revoke": Verb("token:revoke")},
    ),
}


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"rosrv {__version__}")
        raise typer.Exit


def _before_the_verb(
    version: Annotated[
        bool,
        typer.Option("--version", help="Show the version and exit.", callback=_show_version, is_eager=True),
    ] = False,
) -> None:
    pass


app = application(
    VERBS, callback=_before_the_verb, name="rosrv", help="A network-security appliance for ROS 1 robots."
)

_TOLD = frozenset({"ConfigError", "StartError", "NetworkError"})
"""Errors whose text is for a person. By name: their modules are imported only where they can occur."""


def main() -> None:
    """Entry point of the command: errors are words, never a traceback."""
    _open_closed_streams()
    sys.argv[1:] = _asking_for_help(_without_old_flags(sys.argv[1:]))
    try:
        app()
    except Exception as error:  # noqa: BLE001  the last resort; what it was and where is still told
        if any(
            cls.__name__ in _TOLD and cls.__module__.startswith("appliance.") for cls in type(error).__mro__
        ):
            sys.stderr.write(f"rosrv: {error}\n")
            sys.exit(1)
        if isinstance(error, OSError) and error.errno == errno.ENOSPC and error.filename is None:
            sys.stderr.write(f"rosrv: output: {error.strerror}\n")
            sys.exit(2)
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{last.filename}:{last.lineno}"
        sys.stderr.write(
            f"rosrv: a defect of rosrv, please report it: {type(error).__name__}: {error} ({where})\n"
        )
        sys.exit(70)


def _open_closed_streams() -> None:
    """Standard streams that are closed (`>&-`) go to /dev/null; no file that is opened later gets their number."""
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
    sys.stdin = sys.stdin or os.fdopen(0)
    sys.stdout = sys.stdout or os.fdopen(1, "w", encoding="utf-8")
    sys.stderr = sys.stderr or os.fdopen(2, "w", encoding="utf-8")


_OLD_FLAGS = {"-list": "list", "-rvstate": "rvstate", "-enable": "enable", "-disable": "disable"}
"""ROSRV's own flags, and the verbs of `rosrv monitor` that took their place."""


def _without_old_flags(arguments: list[str]) -> list[str]:
    """`rosrv -enable M…` is `rosrv monitor enable M…`."""
    verb = _OLD_FLAGS.get(arguments[0]) if arguments else None
    return arguments if verb is None else ["monitor", verb, *arguments[1:]]


def _asking_for_help(arguments: list[str]) -> list[str]:
    """`rosrv help policy check` is `rosrv policy check --help`, and so is `rosrv policy help check`."""
    if "help" not in arguments[:2]:
        return arguments
    return [*(word for word in arguments[:2] if word != "help"), *arguments[2:], "--help"]


if __name__ == "__main__":
    main()
