"""Tests of `appliance.cli.lazy` and the table of verbs: what is imported, what help says, completion."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from appliance.cli.lazy import loaded
from appliance.cli.main import app
from tests.support.command import commands, table

ROOT = Path(__file__).parents[3]
PAGES = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
ROSRV = str(Path(sys.executable).parent / "rosrv")


def test_the_table_says_what_the_verbs_say() -> None:
    """The help that is known without importing a verb is the first sentence of the verb's own."""
    for name, verb in table():
        own = str(loaded(verb, name.split()[-1]).help)
        assert " ".join(own.split("\n\n", maxsplit=1)[0].split()) == verb.help, name


def test_the_command_imports_only_what_a_verb_needs() -> None:
    """The command, and asking a running appliance, import no network library, REST server, bags or compiler."""
    program = (
        "import sys, appliance.cli.main, appliance.cli.status_verb, appliance.cli.monitor.in_force\n"
        "heavy = ('pyroute2', 'fastapi', 'uvicorn', 'rosbags', 'lark', 'numpy', 'httpx', 'cryptography', 'pydantic')\n"
        "print(*[one for one in heavy if one in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_a_command_reads_texts_and_paths_without_pydantic(tmp_path: Path) -> None:
    """A verb is asked with flags that are texts and paths; a number is typer's to read, and to refuse."""
    program = "import sys\ntry: main()\nfinally: print('pydantic' in sys.modules)"
    status = ["status", "--json", "--state", str(tmp_path)]
    for arguments, has in ((status, "False"), (["audit", "search", "--limit", "many"], "True")):
        done = subprocess.run(
            [sys.executable, "-c", f"from appliance.cli.main import main\n{program}", *arguments],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.stdout.splitlines()[-1] == has, done.stderr


@pytest.mark.parametrize(("name", "command"), [pytest.param(*one, id=one[0]) for one in commands()])
def test_every_verb_has_help_with_an_example(name: str, command: Any) -> None:
    """One sentence first, an example of this very verb, `--json`; every option and argument is explained.

    And some page names the verb.
    """
    if command.hidden or name.rsplit(maxsplit=1)[-1] == "rvstate":
        pytest.skip("kept for ROSRV's own flag")
    assert any(f"rosrv {name}" in page.read_text() for page in PAGES), f"no page names rosrv {name}"
    example = [line for line in str(command.help).splitlines() if "rosrv " in line]
    assert any(f"rosrv {name}" in line for line in example), command.help
    if name != "demo":  # which shows, and tells nothing to a program
        assert any("--json" in one.opts for one in command.params), [one.opts for one in command.params]
    for one in command.params:
        if one.param_type_name == "option":
            assert one.help, (name, one.opts)
    shown = CliRunner().invoke(app, [*name.split(), "--help"])
    assert shown.exit_code == 0
    assert "Usage: " in shown.output


@pytest.mark.parametrize(
    ("typed", "found"),
    [
        ("rosrv ", {"status", "policy", "monitor", "selftest"}), ("rosrv pol", {"policy"}),
        ("rosrv policy re", {"reload", "revisions"}), ("rosrv monitor ", {"list", "load", "resume"}),
        ("rosrv audit ", {"tail", "search", "verify"}), ("rosrv status --", {"--state", "--api", "--json"}),
        ("rosrv monitor load --", {"--msg", "--note", "--api-ca"}),
    ],
)  # fmt: skip
def test_bash_completes(typed: str, found: set[str]) -> None:
    """What bash's completion function asks is answered with verbs and options."""
    words = typed.split(" ")
    env = os.environ | {
        "_ROSRV_COMPLETE": "complete_bash", "COMP_WORDS": typed.strip() if words[-1] else typed,
        "COMP_CWORD": str(len(words) - 1),
    }  # fmt: skip
    done = subprocess.run([ROSRV], env=env, capture_output=True, text=True, timeout=60, check=False)
    assert found <= set(done.stdout.split()), (done.stdout, done.stderr)


def test_the_script_that_is_shown_is_bash(tmp_path: Path) -> None:
    """`--show-completion bash`, read by bash, completes `rosrv`: the function runs and offers verbs."""
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
        ["bash", "--norc", "-c", script],
        env=env,
        capture_output=True,
        text=True,
        timeout=60,
        cwd=tmp_path,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "monitor" in done.stdout.splitlines()[-1]
