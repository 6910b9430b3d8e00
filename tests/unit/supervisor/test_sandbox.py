"""Tests of `appliance.supervisor.sandbox`, where a wall is raised in a process of its own: there is no way back."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from appliance.supervisor.roles import ROLES, Facts
from appliance.supervisor.sandbox import landlock, seccomp
from appliance.supervisor.sandbox.folders import around, furnished, runnable
from appliance.supervisor.sandbox.sandbox_plan import UNIX, Walls
from appliance.supervisor.sandbox.system_calls import FORBIDDEN, LISTED, STARTS_PROGRAMS

_PROGRAM = """
import json, os, socket
from appliance.supervisor import privileges
from appliance.supervisor.users import Account
from appliance.supervisor.sandbox import seccomp
from appliance.supervisor.sandbox.sandbox_plan import Walls
privileges.drop(Account("me", os.geteuid() or 61015, os.getegid() or 61015), parent=os.getppid())
seccomp.raise_wall(Walls(programs=("/usr",)))

def outcome(*arguments):
    try:
        socket.socket(*arguments).close()
    except OSError as error:
        return error.strerror
    return "made"

print(json.dumps({
    "tcp": outcome(socket.AF_INET, socket.SOCK_STREAM),
    "tcp6": outcome(socket.AF_INET6, socket.SOCK_STREAM),
    "udp": outcome(socket.AF_INET, socket.SOCK_DGRAM),
    "netlink": outcome(socket.AF_NETLINK, socket.SOCK_RAW),
    "newest": outcome(63, socket.SOCK_STREAM),
    "beyond": outcome(4000, socket.SOCK_STREAM),
    "unix": outcome(socket.AF_UNIX, socket.SOCK_STREAM),
    "child": os.system("exec " + %r),
}))
"""
_CHILD = f"{sys.executable} -c 'import socket; socket.socket()' 2>/dev/null"
FACTS = Facts(Path("/s"), Path("/s/run/config.json"), 12311, "http://127.0.0.1:5")
HERE = Path("/bin/true")


def test_only_the_families_that_were_granted_can_be_made() -> None:
    """A process of Unix sockets gets none of any network, nor do the programs it starts."""
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM % _CHILD], capture_output=True, text=True, check=True
    )
    outcome = json.loads(done.stdout)
    assert outcome.pop("unix") == "made"
    assert outcome.pop("child") != 0
    assert set(outcome.values()) == {"Operation not permitted"}


def test_a_machine_without_the_library_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """A missing filter is an error with its remedy; who can do without it tells it and goes on."""
    monkeypatch.setattr(seccomp, "LIBRARY", "libnowhere.so.9")
    with pytest.raises(seccomp.SeccompError, match="apt install libseccomp2"):
        seccomp.raise_wall(Walls())


def test_nothing_is_listed_that_is_forbidden() -> None:
    """The lists have no call in common, and each name is there once."""
    assert not set(LISTED) & {
        *FORBIDDEN,
        *STARTS_PROGRAMS,
        "clone3",
        "bind",
        "connect",
        "socket",
        "mmap",
        "mprotect",
    }
    assert len(set(LISTED)) == len(LISTED)
    assert len(set(FORBIDDEN)) == len(FORBIDDEN)


@pytest.mark.parametrize(("abi", "lacks"), [(0, 1), (1, 2), (3, 2), (4, 1), (5, 1), (6, 0), (7, 0)])
def test_what_an_older_kernel_does_not_limit_is_told(abi: int, lacks: int) -> None:
    """Each version is told in words what it leaves open."""
    assert len(landlock.lacking(abi)) == lacks


def test_every_process_of_ours_is_listed_but_that_which_starts_charon() -> None:
    """Who parses what strangers send has a list, and only programs of others (and their starter) run programs."""
    for role in ROLES:
        walls = role.walls(FACTS)
        assert walls.listed is (role.name not in {"rosmaster", "rosout", "charon"}), role.name
        assert bool(walls.programs) is not walls.listed
        assert (walls.families == UNIX) is (role.name in {"signer", "compiler", "api", "recorder"})
        assert role.network or (walls.families, walls.binds, walls.reaches) == (UNIX, (), ())


def test_a_saved_file_may_be_another_of_its_name(tmp_path: Path) -> None:
    """The folder of a configured file is readable, relative ones from where the appliance was started."""
    assert around(tmp_path / "policy.ini", None) == (str(tmp_path),)
    assert around(Path("policy.ini")) == (str(Path.cwd()),)
    (tmp_path / "link").symlink_to("/srv/robot/policy.ini")
    assert around(tmp_path / "link") == (str(tmp_path), "/srv/robot")


def test_a_program_is_itself_and_its_loader(tmp_path: Path) -> None:
    """Links are followed, for it is the file that is executed; a part and the configuration come to all walls."""
    link = tmp_path / "python"
    link.symlink_to("/usr/bin/python3")
    first, *loaders = runnable(link)
    assert first == str(Path("/usr/bin/python3").resolve())
    assert all("ld-linux" in one for one in loaders)
    assert loaders
    walls = furnished(Walls(), "/s/relay", "/s/run")
    assert "/s/run" in walls.reads
    assert walls.writes == ("/s/relay", "/dev/null")
