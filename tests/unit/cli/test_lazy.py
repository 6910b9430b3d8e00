import functools
import os
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from rosrv_fleet.cli import app as fleet_app
from typer.testing import CliRunner

from appliance.cli.lazy import load_command
from appliance.cli.main import app
from appliance.cli.verb_table import Verb
from distribution import command_line_page
from rosmop.tool.command import app as rosmop_app
from tests.support.command import table

ROOT = Path(__file__).parents[3]
PAGES = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
ROSRV = str(Path(sys.executable).parent / "rosrv")


def test_the_table_matches_the_verbs() -> None:
    for name, verb in table():
        own = str(load_command(verb, name.split()[-1]).help)
        assert " ".join(own.split("\n\n", maxsplit=1)[0].split()) == verb.help, name


@pytest.mark.nightly
def test_a_verb_imports_only_what_it_needs() -> None:
    program = (
        "import pkgutil, sys, appliance.cli.status_verb\n"
        "from appliance.cli.main import all_verbs\n"
        "pkgutil.resolve_name(all_verbs()['monitor'].verbs['list'].path)\n"
        "heavy = ('pyroute2', 'fastapi', 'uvicorn', 'rosbags', 'lark', 'numpy', 'httpx', 'cryptography', 'pydantic')\n"
        "print(*[one for one in heavy if one in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


@functools.cache
def pages() -> str:
    return "\n".join(page.read_text() for page in PAGES)


@pytest.mark.parametrize(("name", "verb"), [pytest.param(*row, id=row[0]) for row in table()])
def test_every_verb_has_help_with_an_example(name: str, verb: Verb) -> None:
    command = load_command(verb, name.rsplit(maxsplit=1)[-1])
    if command.hidden or name.rsplit(maxsplit=1)[-1] == "rvstate":  # it only gives ROSRV's own flags a name
        return
    assert f"rosrv {name}" in pages(), f"no page names rosrv {name}"
    example = [line for line in str(command.help).splitlines() if "rosrv " in line]
    assert any(f"rosrv {name}" in line for line in example), command.help
    if name != "demo":  # draws on the screen, prints nothing for a program
        assert any("--json" in one.opts for one in command.params), [one.opts for one in command.params]
    shown = CliRunner().invoke(app, [*name.split(), "-h"])
    assert "<bool>" not in shown.output, "a flag takes no value"
    assert shown.exit_code == 0
    assert "Usage: " in shown.output


@pytest.mark.parametrize("program", [app, rosmop_app, fleet_app], ids=["rosrv", "rosmop", "rosrv-fleet"])
def test_every_argument_and_option_has_help(program: typer.Typer) -> None:
    """A name such as MONITOR or PRESET alone does not say which values exist."""
    assert [
        f"{' '.join(words)} {param.name}"
        for words, command, context in command_line_page.commands(("",), program)
        for param in command.get_params(context)
        if not hasattr(command, "list_commands") and not param.hidden and not param.help
    ] == []


@pytest.mark.nightly
def test_the_completion_script_is_valid_bash(tmp_path: Path) -> None:
    env = {
        key: value
        for key, value in os.environ.items()
        if key != "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION"
    }
    env["PATH"] = f"{Path(ROSRV).parent}:{env.get('PATH', '')}"
    script = (
        'eval "$(rosrv --show-completion bash)" && complete -p rosrv && '
        "COMP_WORDS=(rosrv mon) COMP_CWORD=1 && $(complete -p rosrv | sed 's/.*-F \\([^ ]*\\).*/\\1/') rosrv && "
        'echo "${COMPREPLY[@]}"'
    )
    env["_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION"] = "1"
    done = subprocess.run(
        ["bash", "--norc", "-c", script], env=env, capture_output=True, text=True, timeout=60, cwd=tmp_path,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "monitor" in done.stdout.splitlines()[-1]
