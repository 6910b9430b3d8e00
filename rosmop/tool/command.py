"""The commands `check`, `run`, `learn` and `coverage`, for `rosmop` and for `rosrv monitor`."""

from collections.abc import Callable
from pathlib import Path

import typer

from rosmop.tool import check_command, coverage_command, learn_command, run_command
from rosmop.tool.batch_session import RecordingsOptions
from rosmop.tool.command_context import CommandContext
from rosmop.tool.options import (
    Bags,
    BagSets,
    Dot,
    FailUnder,
    Files,
    Folders,
    HoldOut,
    Json,
    On,
    Out,
    Output,
    Prove,
    ReportFile,
    Resume,
    ShowProgress,
    Svg,
    Topics,
    WhySlow,
    Workers,
)
from rosmop.tool.summaries import SUMMARIES
from rosmop.tool.terminal import reflow

_Command = Callable[..., None]
_EXAMPLES = {
    "check": "monitors/*.rv",
    "run": "monitors/safe_triggering.rv --bag drive.bag",
    "learn": "--bag mon.bag --bag tue.bag --output learnt.rv",
    "coverage": "monitors/*.rv --bag drive.bag --fail-under 80",
}


def commands_of(program: CommandContext) -> dict[str, _Command]:
    commands = {
        "check": _check_of(program),
        "run": _run_of(program),
        "learn": _learn_of(program),
        "coverage": _coverage_of(program),
    }
    for name, command in commands.items():
        more = [reflow(command.__doc__)] if command.__doc__ else []
        command.__doc__ = "\n\n".join([*more, f"Example: {program.name} {name} {_EXAMPLES[name]}"])
    return commands


def _check_of(program: CommandContext) -> _Command:
    def check(
        files: Files,
        *,
        as_json: Json = False,
        msg: Folders = None,
        prove: Prove = False,
        why_slow: WhySlow = False,
        dot: Dot = None,
        svg: Svg = None,
    ) -> None:
        """`--prove` needs the packages z3-solver and wasmtime, and takes up to a few seconds for each event. It prints
        what is proved for each event. Exit status 1 if the compiled code of an event differs from its
        specification.
        """
        status = check_command.check(
            program, files, msg or [], as_json=as_json, prove=prove, why_slow=why_slow, dot=dot, svg=svg
        )
        raise typer.Exit(status)

    return check


def _run_of(program: CommandContext) -> _Command:
    def run(
        files: Files,
        *,
        bags: Bags = None,
        sets: BagSets = None,
        as_json: Json = False,
        output: Output = None,
        msg: Folders = None,
        workers: Workers = None,
        on: On = None,
        resume: Resume = None,
        report: ReportFile = None,
        show_progress: ShowProgress = False,
    ) -> None:
        """Exit status 3 if recordings failed: they are in the report, and the others are complete."""
        options = RecordingsOptions(bags or [], sets or [], workers, on, resume, report, show_progress)
        raise typer.Exit(run_command.run(program, files, msg or [], options, output=output, as_json=as_json))

    return run


def _learn_of(program: CommandContext) -> _Command:
    def learn(
        *,
        bags: Bags = None,
        sets: BagSets = None,
        topics: Topics = None,
        out: Out = None,
        hold_out: HoldOut = 0.3,
        as_json: Json = False,
        workers: Workers = None,
        on: On = None,
        resume: Resume = None,
        report: ReportFile = None,
        show_progress: ShowProgress = False,
    ) -> None:
        """Exit status 3 if recordings failed: they are reported, and the result is from the others."""
        options = RecordingsOptions(bags or [], sets or [], workers, on, resume, report, show_progress)
        status = learn_command.learn_monitors(
            program, options, topics or [], out, hold_out=hold_out, as_json=as_json
        )
        raise typer.Exit(status)

    return learn


def _coverage_of(program: CommandContext) -> _Command:
    def coverage(
        files: Files,
        *,
        bags: Bags = None,
        sets: BagSets = None,
        msg: Folders = None,
        fail_under: FailUnder = 0.0,
        as_json: Json = False,
        workers: Workers = None,
        on: On = None,
        resume: Resume = None,
        report: ReportFile = None,
        show_progress: ShowProgress = False,
    ) -> None:
        """Exit status 3 if recordings failed: they are reported, and not counted."""
        options = RecordingsOptions(bags or [], sets or [], workers, on, resume, report, show_progress)
        status = coverage_command.coverage(
            program, files, msg or [], options, fail_under=fail_under, as_json=as_json
        )
        raise typer.Exit(status)

    return coverage


app = typer.Typer(
    name="rosmop",
    help="Runtime monitors for ROS 1: check specifications and run them on recordings.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for _name, _command in commands_of(CommandContext("rosmop", Path.write_bytes)).items():
    app.command(_name, help=f"{SUMMARIES[_name]}\n\n{_command.__doc__}")(_command)
