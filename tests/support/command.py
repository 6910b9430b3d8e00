import contextlib
import io
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

from appliance.cli import main
from appliance.cli.lazy import load_command
from appliance.cli.verb_table import Group, Verb, Verbs

ROSRV = str(Path(sys.executable).parent / "rosrv")
_ONE_AT_A_TIME = threading.Lock()  # a process has one standard output


def rosrv(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [ROSRV, *arguments]
    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True) for _ in range(2))
    with (
        _ONE_AT_A_TIME,
        mock.patch.dict(os.environ, environment),
        mock.patch.object(sys, "argv", command),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        for name in [
            one for one in os.environ if one.startswith(("ROS_", "ROSRV_")) and one not in environment
        ]:
            del os.environ[name]
        try:
            main.main()
            status = 0
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else int(end.code is not None)
    said, wrong = (one.buffer.getvalue().decode() for one in (out, err))
    return subprocess.CompletedProcess(command, status, said, wrong)


def table(verbs: Verbs | None = None) -> Iterator[tuple[str, Verb]]:
    for name, one in (main.all_verbs() if verbs is None else verbs).items():
        if isinstance(one, Group):
            yield from ((f"{name} {inner}", verb) for inner, verb in table(one.verbs))
        else:
            yield name, one


@cache
def commands() -> tuple[tuple[str, Any], ...]:
    return tuple((name, load_command(verb, name.split()[-1])) for name, verb in table())
