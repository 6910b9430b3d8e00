"""The files that every process reads, and those a program needs to run at all."""

import sys
from dataclasses import replace
from pathlib import Path

import appliance
from appliance.supervisor.sandbox.sandbox_plan import Walls

_SYSTEM = ("/usr", "/lib", "/lib32", "/lib64", "/bin", "/sbin", "/etc", "/dev", "/proc", "/sys")
_RESOLVER = Path("/etc/resolv.conf")  # often a link to a folder of the program that writes it
_LOADERS = (("/lib", "ld-linux-*"), ("/lib64", "ld-linux-*"))


def furnished(walls: Walls, home: str, run: str) -> Walls:
    """Walls with the system, Python, our code and the resolved configuration in `run` to read, and `home` to write."""
    code = {sys.prefix, sys.base_prefix, str(Path(appliance.__file__).parent.parent)}
    return replace(
        walls,
        reads=(*walls.reads, *_SYSTEM, str(_RESOLVER.resolve().parent), *code, run),
        writes=(*walls.writes, home, "/dev/null"),
    )


def runnable(program: Path) -> tuple[str, ...]:
    """What must be executable so that this program runs: itself, without links, and the loader of its libraries."""
    loaders = (loader for folder, name in _LOADERS for loader in Path(folder).glob(name))
    return (str(program.resolve()), *(str(loader.resolve()) for loader in loaders))


def around(*files: Path | None) -> tuple[str, ...]:
    """The folders of these files and folders, and of what they are links to: who saves a file often makes a new one."""
    given = [file for file in files if file is not None]
    found = [str(place.parent) for file in given for place in (file.absolute(), file.resolve())]
    return tuple(dict.fromkeys(found))
