"""Transcripts of the command line: text files with commands, their output and their exit status.

    # A title states the promise of the lines below

    file p.ini
        [Nodes]
        x = *
    control status
        version: "1.0"
    $ rosrv policy check p.ini
        p.ini:2:1: error: ...
        [1]

A line at the margin is an action; the indented lines below it are its input or its result:

    file NAME               these lines are a file
    control VERB            the answer of the appliance to this request, as YAML; omitted fields are empty or zero
    control VERB TROUBLE    its rejection: an error, and findings
    now TIME                the time of the system clock, and no time passes
    rest STATUS [PROBLEM]   every answer over REST: a body, or the detail of a problem; `Retry-After=7` is a header
    $ COMMAND               `-> ` a request that reached the appliance, standard output, `2> ` standard error,
                            `[2]` the exit status unless it is 0

A test can add its own actions. Actions before the first title belong to every section. A `rosrv` at the beginning of
a command runs within the test, with words that bash expands; bash runs all other commands, in which `rosrv` is the
installed one. `| fields NAME...` prints these fields of output in JSON. At first the working folder only has `state`,
the state directory. `$REST` is the URL of REST, and `$ROOT` the folder of the project.

In output `<time>`, `<id>` (of a record or recording), `<log>` (its id), `<sha256>`, `<version>` (ours) and `<number>`
are placeholders; `<here>` is the working folder and `<rest>` the URL. `...` is any text in a line; as a separate
line, any lines. A line with characters that could change a terminal is marked `(unprintable)`.

`TRANSCRIPTS=write` writes the output of this run into the file, to be read and kept or corrected.
"""

import contextlib
import datetime
import json
import os
import re
import subprocess
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, get_args

import msgspec
import pytest
import yaml

from appliance import __version__
from appliance.base.clock import using
from appliance.channel.admin import Trouble
from tests.support.command import ROSRV, rosrv
from tests.support.fake_appliance import TOKEN, FakeAppliance
from tests.support.virtual_clock import VirtualClock

Done = subprocess.CompletedProcess[str]
Runner = Callable[..., Done]
_PLACEHOLDERS = {
    "<time>": r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(?::\d\d)?(?:\.\d+)?(?:Z|[+]00:00)?",
    "<id>": r"[0-9a-f]{20}",
    "<sha256>": r"[0-9a-f]{64}",
    "<log>": r"[0-9a-f]{32}",
    "<number>": r"\d+(?:\.\d+)?",
    "<version>": re.escape(__version__),
    "...": r".*?",
}
_ANY_LINES = "(?:.*\n)*?"
_MARKS = re.compile(f"({'|'.join(map(re.escape, _PLACEHOLDERS))})")
_ROSRV = re.compile(r"((?:\w+=(?:'[^']*'|\S*) )*rosrv\b.*?)(?: ([|>] .*))?")
_ENVIRONMENT = {"ROSRV_STATE": "state", "ROSRV_TOKEN": TOKEN, "COLUMNS": "200", "TERM": "dumb"}
_ROOT = Path(__file__).parents[2]
_PATH = f"{Path(ROSRV).parent}:{os.environ.get('PATH', '')}"


class Section(NamedTuple):
    file: Path
    title: str
    head: str
    steps: str

    @property
    def text(self) -> str:
        return f"{self.head}\n{self.steps}".strip()

    def played(self, transcript: "Transcript") -> str:
        played = transcript.play(self.text)
        if os.environ.get("TRANSCRIPTS") == "write":
            steps = played.removeprefix(self.head).strip()
            text = self.file.read_text(encoding="utf-8")
            text = text.replace(f"# {self.title}\n{self.steps}", f"# {self.title}\n{steps}")
            self.file.write_text(text, encoding="utf-8")
        return played


def sections(*files: Path) -> list[Any]:
    found = []
    for file in files:
        head, *texts = f"\n{file.read_text(encoding='utf-8')}".split("\n# ")
        for text in texts:
            title, _, steps = text.partition("\n")
            section = Section(file, title, head.strip(), steps.rstrip())
            found.append(pytest.param(section, id=f"{file.stem}: {title}"))
    return found


class Transcript:
    def __init__(
        self, fake: FakeAppliance, run: Runner = rosrv, more: Mapping[str, Callable[..., None]] | None = None
    ) -> None:
        self._fake = fake
        self._run = run
        self._more = more or {}
        self._serves = False
        self._url = ""
        self._now: float | None = None
        Path("state").mkdir()

    def play(self, text: str) -> str:
        played: list[str] = []
        for action, below in _actions(text):
            came = self._act(action, below)
            played += [action, *(f"    {line}".rstrip() for line in came)]
        return "\n".join(played)

    def _act(self, action: str, below: list[str]) -> list[str]:
        match action.split():
            case ["$", *_]:
                came = self._command(action.removeprefix("$ "))
                return below if _matches(below, came) else [_as_written(line, below) for line in came]
            case ["file", name]:
                Path(name).parent.mkdir(parents=True, exist_ok=True)
                Path(name).write_text("".join(f"{line}\n" for line in below), encoding="utf-8")
            case ["control", *words]:
                self._answer(words, below)
            case ["now", time]:
                self._now = datetime.datetime.fromisoformat(time).timestamp()
            case ["rest", status, *words]:
                self._serve_rest(int(status), words, "\n".join(below))
            case [name, *words] if name in self._more:
                self._more[name](*words, below=below)
            case _:
                raise ValueError(f"unknown action: {action}")
        return below

    def _answer(self, words: list[str], below: list[str]) -> None:
        if not self._serves:
            self._fake.serve(Path("state"))
            self._serves = True
        if len(words) > 1 and words[-1] in get_args(Trouble):
            self._fake.reject(" ".join(words[:-1]), msgspec.convert(words[-1], Trouble), *below)
        else:
            self._fake.answer(" ".join(words), **(yaml.safe_load("\n".join(below)) or {}))

    def _serve_rest(self, status: int, words: list[str], body: str) -> None:
        headers = dict(word.split("=", 1) for word in words if "=" in word)
        if kinds := [word for word in words if "=" not in word]:
            self._fake.problem(status, kinds[0], body, headers)
        else:
            self._fake.status, self._fake.body, self._fake.headers = status, body.encode(), headers
        self._url = self._fake.url

    def _command(self, command: str) -> list[str]:
        self._fake.requests.clear()
        match = _ROSRV.fullmatch(command)
        done = self._bash(command) if match is None else self._rosrv(match[1], match[2])
        lines = [f"-> {request}" for request in self._fake.requests]
        lines += done.stdout.splitlines()
        lines += [f"2> {line}" for line in done.stderr.splitlines()]
        lines += [f"[{done.returncode}]"] * (done.returncode != 0)
        return [self._shown(line) for line in lines]

    def _rosrv(self, words: str, then: str | None) -> Done:
        expanded = self._bash(f"printf '%s\\0' {words}").stdout.split("\0")[:-1]
        place = expanded.index("rosrv")
        own = dict(word.split("=", 1) for word in expanded[:place])
        with _frozen(self._now):
            done = self._run(*expanded[place + 1 :], **_ENVIRONMENT | own)
        if then is None:
            return done
        if then.startswith("| fields "):
            done.stdout = _fields(done.stdout, then.split()[2:])
            return done
        after = self._bash(f"cat {then}", done.stdout)
        return Done([], done.returncode or after.returncode, after.stdout, done.stderr + after.stderr)

    def _bash(self, command: str, given: str = "") -> Done:
        return subprocess.run(
            ["/bin/bash", "-c", command], input=given, capture_output=True, check=False, timeout=60,
            encoding="utf-8", errors="surrogateescape",
            env=os.environ | _ENVIRONMENT | {"PATH": _PATH, "REST": self._url, "ROOT": str(_ROOT)},
        )  # fmt: skip

    def _shown(self, line: str) -> str:
        line = line.replace(str(Path.cwd()), "<here>").replace(str(_ROOT), "$ROOT")
        line = line.replace(self._url, "<rest>") if self._url else line
        return line.rstrip() if line.isprintable() else f"{ascii(line)[1:-1]} (unprintable)"


@contextlib.contextmanager
def _frozen(now: float | None) -> Iterator[None]:
    if now is None:
        yield
    else:
        with using(VirtualClock(wall=int(now))):
            yield


def _actions(text: str) -> Iterator[tuple[str, list[str]]]:
    action, below = "", list[str]()
    for line in text.splitlines():
        if line and not line.startswith("    "):
            if action:
                yield action, below
            action, below = line, []
        else:
            below.append(line[4:])
    if action:
        yield action, below


def _matches(written: list[str], came: list[str]) -> bool:
    pattern = "".join(_ANY_LINES if line == "..." else f"{_pattern(line)}\n" for line in written)
    return re.fullmatch(pattern, "".join(f"{line}\n" for line in came)) is not None


def _as_written(line: str, written: list[str]) -> str:
    return next((one for one in written if "<" in one and re.fullmatch(_pattern(one), line)), line)


def _pattern(line: str) -> str:
    return "".join(_PLACEHOLDERS.get(part) or re.escape(part) for part in _MARKS.split(line))


def _fields(output: str, names: list[str]) -> str:
    rows = [json.loads(line) for line in output.splitlines()]
    return "".join(" ".join(_field(row, name) for name in names) + "\n" for row in rows)


def _field(row: Any, name: str) -> str:
    for step in name.split("."):
        row = row.get(step) if isinstance(row, dict) else None
    return row if isinstance(row, str) and row.isprintable() else json.dumps(row, separators=(", ", ": "))
