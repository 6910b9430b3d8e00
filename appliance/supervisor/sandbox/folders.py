"""List the files that every process reads, and the files that a program needs to run."""

import sys
from dataclasses import replace
from pathlib import Path

import appliance
from appliance.supervisor.sandbox.sandbox_plan import SandboxPlan

_SYSTEM = ("/usr", "/lib", "/lib32", "/lib64", "/bin", "/sbin", "/etc", "/dev", "/proc", "/sys")
_RESOLVER = Path("/etc/resolv.conf")  # often a link to a file in another folder
_LOADERS = (("/lib", "ld-linux-*"), ("/lib64", "ld-linux-*"))


def with_system_files(sandbox: SandboxPlan, home: str, run: str) -> SandboxPlan:
    # The paths by which `process_handle` starts the process; a private view has no other.
    code = {
        str(Path(sys.prefix).resolve()),
        sys.base_prefix,
        str(Path(appliance.__file__).resolve().parent.parent),
    }
    return replace(
        sandbox,
        reads=(*sandbox.reads, *_SYSTEM, str(_RESOLVER.resolve().parent), *code, run),
        writes=(*sandbox.writes, home, "/dev/null"),
    )


def executables_of(program: Path) -> tuple[str, ...]:
    loaders = (loader for folder, name in _LOADERS for loader in Path(folder).glob(name))
    return (str(program.resolve()), *(str(loader.resolve()) for loader in loaders))


def folders_of(*files: Path | None) -> tuple[str, ...]:
    """Return the folders of files, because editors often replace a file when they save it."""
    given = [file for file in files if file is not None]
    found = [str(place.parent) for file in given for place in (file.absolute(), file.resolve())]
    return tuple(dict.fromkeys(found))
