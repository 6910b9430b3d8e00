"""The answers of every verb to wrong input: no traceback, and a next step."""

import ast
import re
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.core import TyperArgument

from appliance.base.user_errors import with_remedy
from tests.support.command import commands, rosrv

ROOT = Path(__file__).parents[3]
VERBS = dict(commands())
# These act on the machine or the network before they see a state directory.
ACTING = {"demo", "survey", "selftest", "adopt", "release", "protect", "version", "evidence verifier"}
REMEDY = re.compile(
    r"[:;(,] ?(?:or )?(?:add|choose|create|did you mean|give|leave|list|make|name|put|run|rosrv|set|start|take)\b"
    r"|[:;(,] ?(?:or )?(?:use|write|the first appliance writes it)\b"
    r"|with --\w|\(--\w+|Missing (?:option|argument)|Invalid value for|No such option|must be|needs --"
    r"|cannot (?:be )?read|: No such file or directory$"
)
RAW = re.compile(r"Traceback|\[Errno|(?:Key|Type|Value|Attribute|Assertion|OS)Error|a defect (?:in|of) rosrv")


def wrong_call(name: str) -> list[str]:
    """Return a command line whose every argument and state directory is wrong."""
    given = name.split()
    for parameter in VERBS[name].params:
        if isinstance(parameter, TyperArgument):
            given.append("no such thing")
        elif parameter.required:
            given += [max(parameter.opts, key=len), "no such thing"]
    known = {option for parameter in VERBS[name].params for option in parameter.opts}
    if "--config" in known:
        return [*given, "--config", "nowhere"]
    return [*given, *(["--state", "nowhere"] if "--state" in known else [])]


@pytest.mark.parametrize("name", sorted(VERBS.keys() - ACTING))
def test_wrong_input_gets_an_error_with_a_next_step(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = rosrv(*wrong_call(name))
    said = done.stderr or done.stdout
    assert done.returncode in (1, 2), said
    assert not RAW.search(done.stdout + done.stderr), said
    assert REMEDY.search(" ".join(said.replace("│", " ").split())), said
    assert list(tmp_path.iterdir()) == []


NUMBERED = [
    (name, parameter)
    for name in sorted(VERBS.keys() - ACTING - {"up"})
    for parameter in VERBS[name].params
    if (parameter.display_type(typer.Context(VERBS[name])) or "").startswith("<int")
]


@pytest.mark.parametrize(("name", "parameter"), NUMBERED)
def test_a_huge_number_is_refused(name: str, parameter: Any) -> None:
    given = wrong_call(name)
    huge = "9" * 30
    if isinstance(parameter, TyperArgument):
        given = [huge if word == "no such thing" else word for word in given]
    else:
        given += [max(parameter.opts, key=len), huge]
    done = rosrv(*given)
    assert done.returncode in (1, 2)
    assert not RAW.search(done.stdout + done.stderr), done.stderr


TIMED = [
    (name, option, parameter.metavar)
    for name, command in VERBS.items()
    for parameter in command.params
    for option in parameter.opts
    if parameter.metavar in ("TIME", "DURATION") and not isinstance(parameter, TyperArgument)
]


@pytest.mark.parametrize(("name", "option", "kind"), TIMED)
def test_a_wrong_time_names_its_option(name: str, option: str, kind: str) -> None:
    """The options of a running appliance are read after it answers, so only those read before are seen here."""
    done = (
        rosrv(*wrong_call(name), option, "3 months")
        if name not in ACTING
        else rosrv(name, option, "3 months")
    )
    said = " ".join(done.stderr.split())
    assert done.returncode in (1, 2), said
    assert not RAW.search(said), said
    if "'3 months'" in said:
        noun = "a duration" if kind == "DURATION" else "a valid time"
        assert re.search(rf"{option}:? '3 months' is not {noun}: (?:write|use) ", said), said


def _handlers(path: Path) -> list[str]:
    handlers = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.ExceptHandler) or node.name is None or not _only_os(node.type):
            continue
        for value in ast.walk(node):
            if not isinstance(value, ast.FormattedValue) or not isinstance(value.value, ast.Name):
                continue
            if value.value.id == node.name:
                handlers.append(f"{path.relative_to(ROOT)}:{value.lineno}")
    return handlers


def _only_os(kind: Any) -> bool:
    names = kind.elts if isinstance(kind, ast.Tuple) else [kind]
    return bool(names) and all(
        isinstance(name, ast.Name) and (name.id == "OSError" or "File" in name.id) for name in names
    )


def test_no_verb_prints_an_error_of_the_system_as_python_writes_it() -> None:
    """`[Errno 2] No such file or directory: 'x'`: use `with_remedy`, or `strerror`."""
    files = [
        *(ROOT / "appliance" / "cli").rglob("*.py"),
        *(ROOT / "appliance" / "features").rglob("*verb*.py"),
    ]
    assert len(files) > 40
    assert [place for path in files for place in _handlers(path)] == []


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (FileExistsError(17, "File exists", "x.ini"), "x.ini: File exists; name a new file"),
        (PermissionError(13, "Permission denied", "x"), "x: Permission denied; run this as root"),
        (OSError(28, "No space left", "x"), "x: No space left; free some space, or name another disk"),
        (FileNotFoundError(2, "No such file", "/nowhere/x"), "/nowhere/x: No such file; create its folder first"),
        (OSError("odd"), "odd"),
    ],
)  # fmt: skip
def test_an_error_of_the_system_has_a_remedy(error: OSError, text: str) -> None:
    assert with_remedy(error) == text
