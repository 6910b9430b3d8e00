"""The `rosrv` command: one app, one module for each verb, imported when it is run (`lazy.py`)."""

import sys
import traceback
from typing import Annotated

import typer

from appliance import __version__
from appliance.cli.lazy import Group, Verb, application

VERBS: dict[str, Verb | Group] = {
    "up": Verb("appliance.cli.up:up", "Start the appliance; ends on SIGTERM or Ctrl-C."),
    "status": Verb(
        "appliance.cli.status:status",
        "Show the running appliance: processes, isolation, policy, graph, audit log.",
    ),
    "selftest": Verb(
        "appliance.cli.selftest.verb:selftest",
        "Try whether this machine can run the appliance, and whether the running one does what it must.",
    ),
    "demo": Verb(
        "appliance.cli.demo:demo",
        "Show the appliance at work: a simulated robot, its operator and an attacker. Needs root.",
    ),
    "protect": Verb(
        "appliance.cli.protect:protect", "Close the ROS ports of this machine to all but the appliance."
    ),
    "audit": Verb("appliance.cli.audit.verbs:app", "Review the audit log and prove that it is complete."),
    "evidence": Group(
        "Evidence: what happened, in one file that proves itself elsewhere.",
        {
            "export": Verb(
                "appliance.cli.evidence:export_evidence",
                "Write what the log has of a time, and what was in force, as a bundle that proves itself anywhere.",
            ),
            "verify": Verb(
                "appliance.cli.evidence:verify",
                "Hold a bundle against what the appliance signed: exit status 0 right, 1 not, 2 when it is no bundle.",
            ),
            "verifier": Verb(
                "appliance.cli.evidence:verifier",
                "Write the verifier that comes with this version, for who does not trust the one in a bundle.",
            ),
        },
    ),
    "policy": Verb(
        "appliance.cli.policy.verbs:app", "Check, explain, test, compare, learn and change access policies."
    ),
    "monitor": Group(
        "Monitors: check specifications, try them on a recording, run them on the robot.",
        {
            "check": Verb(
                "appliance.cli.monitor.verbs:check",
                "Report every error and warning with its place; exit status 1 if there is an error.",
            ),
            "run": Verb(
                "appliance.cli.monitor.verbs:run",
                "Give a recording to the monitors and report what came of every message, by the recording's clock.",
            ),
            "learn": Verb(
                "appliance.cli.monitor.learning:learn_monitors",
                "Propose specifications out of recordings of a robot that behaves, for a person to edit.",
            ),
            "replay": Verb(
                "appliance.cli.monitor.replaying:replay_monitor",
                "Say what a monitor would have dropped and changed of recordings, where, and how often.",
            ),
            "coverage": Verb(
                "appliance.cli.monitor.coverage:coverage",
                "Say which events, branches, handlers, states and transitions recordings exercised, and what never"
                " happened.",
            ),
            "list": Verb(
                "appliance.cli.monitor.running:list_monitors",
                "Show every monitor: enabled or not, what it listens to, what it did.",
            ),
            "margins": Verb(
                "appliance.cli.monitor.running:margins",
                "Show how close conditions on numbers came, today and since they were loaded.",
            ),
            "enable": Verb(
                "appliance.cli.monitor.running:enable",
                "Let the events of these monitors happen again, or first on trial.",
            ),
            "promote": Verb(
                "appliance.cli.monitor.running:promote",
                "Bring monitors that are on trial into force, with the state that they have.",
            ),
            "disable": Verb(
                "appliance.cli.monitor.running:disable",
                "Let messages pass these monitors untouched; their variables stay.",
            ),
            "load": Verb(
                "appliance.cli.monitor.running:load",
                "Load specifications while the robot runs; a file of the same name is replaced.",
            ),
            "remove": Verb(
                "appliance.cli.monitor.running:remove",
                "Remove specifications, by the names of their monitors or files.",
            ),
            "reload": Verb(
                "appliance.cli.monitor.running:reload",
                "Take what the folder of specifications has now; what it does not have stays in force, and is named.",
            ),
            "revisions": Verb(
                "appliance.cli.monitor.revisions:revisions",
                "List the kept revisions of the specifications, the newest first.",
            ),
            "show": Verb("appliance.cli.monitor.revisions:show", "Show the specifications of a revision."),
            "diff": Verb(
                "appliance.cli.monitor.revisions:diff",
                "Show what a revision changed of the texts; exit status 1 when they are different.",
            ),
            "rollback": Verb(
                "appliance.cli.monitor.revisions:rollback",
                "Bring a kept revision of the specifications into force again; what comes back is switched as it was.",
            ),
            "confirm": Verb(
                "appliance.cli.monitor.revisions:confirm",
                "Keep what was loaded with --confirm-within; exit status 1 when there is nothing to confirm.",
            ),
            "resume": Verb(
                "appliance.cli.monitor.running:resume",
                "Let the topics go on that these monitors hold since the relay was restarted (`hold` specifications).",
            ),
            "reset": Verb(
                "appliance.cli.monitor.offline:reset",
                "Give up the specifications that were loaded by command: the next start takes those of the folder.",
            ),
            "rvstate": Verb(
                "appliance.cli.monitor.running:rv_state",
                "ROSRV's `-rvstate`: the ports of ROSMaster and RVMaster, and where each monitor's topics are carried.",
                hidden=True,
            ),
        },
    ),
    "topic": Group(
        "What is said on the topics of the running robot.",
        {
            "echo": Verb(
                "appliance.cli.topic:echo",
                "Show the next messages of a topic as subscribers get them, after the monitors; it is recorded who"
                " looked.",
            ),
            "info": Verb(
                "appliance.cli.topic:info", "Show who publishes a topic, who hears it, and how much flows."
            ),
        },
    ),
    "record": Group(
        "The flight recorder: what was said before and after something happened.",
        {
            "now": Verb(
                "appliance.cli.record:now",
                "Record the last seconds, and the next ones, of what the robot says.",
            ),
            "list": Verb(
                "appliance.cli.record:list_recordings", "List the recordings that are kept, the oldest first."
            ),
            "show": Verb("appliance.cli.record:show", "Show why a recording was made, and what it has."),
            "timeline": Verb(
                "appliance.cli.record:show_timeline",
                "Show what flowed on each topic of a recording, and what happened, on one time line.",
            ),
            "messages": Verb(
                "appliance.cli.record:messages",
                "Show the messages of a recording around a moment; it is recorded who read them.",
            ),
            "fetch": Verb(
                "appliance.cli.record:fetch",
                "Write a recording's bag to a file; it is recorded who fetched it.",
            ),
            "remove": Verb(
                "appliance.cli.record:remove", "Remove a recording; it is recorded who removed it."
            ),
        },
    ),
    "sign": Verb(
        "appliance.cli.sign:sign",
        "Sign policies, specifications and message definitions; the signature of FILE is written to FILE.sig.",
    ),
    "version": Verb("appliance.cli.version:version", "Show which version this is, and what it stands on."),
    "config": Verb("appliance.cli.config:app", "Check or show the configuration."),
    "host": Verb(
        "appliance.cli.host.verbs:app", "Enrol, list and revoke hosts that come through IPsec tunnels."
    ),
    "backup": Verb(
        "appliance.cli.backup:backup",
        "Write the state directory to one file: audit log, registrations, policies, keys. The appliance may run.",
    ),
    "restore": Verb(
        "appliance.cli.backup:restore",
        "Make a state directory of a backup; `rosrv up --state` there goes on from it. Nothing is written over.",
    ),
    "purge": Verb(
        "appliance.cli.backup:purge",
        "Remove a state directory for good: audit log, policies, keys of the appliance and of its hosts. It must not"
        " run.",
    ),
    "token": Verb("appliance.cli.token:app", "Make, list and revoke access tokens for REST."),
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
    sys.argv[1:] = _asking_for_help(_without_old_flags(sys.argv[1:]))
    try:
        app()
    except Exception as error:  # noqa: BLE001  the last resort; what it was and where is still told
        if any(
            cls.__name__ in _TOLD and cls.__module__.startswith("appliance.") for cls in type(error).__mro__
        ):
            sys.stderr.write(f"rosrv: {error}\n")
            sys.exit(1)
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{last.filename}:{last.lineno}"
        sys.stderr.write(
            f"rosrv: a defect of rosrv, please report it: {type(error).__name__}: {error} ({where})\n"
        )
        sys.exit(70)


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
