import json
import subprocess
import sys
from pathlib import Path

import pytest

from appliance.supervisor.role import Facts
from appliance.supervisor.roles import ROLES
from appliance.supervisor.sandbox import landlock, seccomp
from appliance.supervisor.sandbox.folders import executables_of, folders_of, with_system_files
from appliance.supervisor.sandbox.sandbox_plan import UNIX, SandboxPlan
from appliance.supervisor.sandbox.seccomp import ALLOWED, FORBIDDEN, STARTS_PROGRAMS

_PROGRAM = """
import json, os, socket
from appliance.supervisor import privileges
from appliance.supervisor.users import Account
from appliance.supervisor.sandbox import seccomp
from appliance.supervisor.sandbox.sandbox_plan import SandboxPlan
privileges.drop_privileges(Account("me", os.geteuid() or 61015, os.getegid() or 61015), parent=os.getppid())
seccomp.load_filter(SandboxPlan(programs=("/usr",)))

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


@pytest.mark.nightly
def test_only_sockets_of_granted_families_can_be_opened() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM % _CHILD], capture_output=True, text=True, check=True
    )
    outcome = json.loads(done.stdout)
    assert outcome.pop("unix") == "made"
    assert outcome.pop("child") != 0
    assert set(outcome.values()) == {"Operation not permitted"}


def test_a_machine_without_the_library_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(seccomp, "LIBRARY", "libnowhere.so.9")
    with pytest.raises(seccomp.SeccompError, match="apt install libseccomp2"):
        seccomp.load_filter(SandboxPlan())


def test_no_call_is_both_allowed_and_forbidden() -> None:
    assert not set(ALLOWED) & {
        *FORBIDDEN,
        *STARTS_PROGRAMS,
        "clone3",
        "bind",
        "connect",
        "socket",
        "mmap",
        "mprotect",
    }
    assert len(set(ALLOWED)) == len(ALLOWED)
    assert len(set(FORBIDDEN)) == len(FORBIDDEN)


@pytest.mark.parametrize(("abi", "lacks"), [(0, 1), (1, 2), (3, 2), (4, 1), (5, 1), (6, 0), (7, 0)])
def test_missing_limits_of_an_older_kernel_are_reported(abi: int, lacks: int) -> None:
    assert len(landlock.lacking(abi)) == lacks


def test_each_process_has_a_list_except_the_starter_of_charon() -> None:
    for role in ROLES:
        sandbox = role.sandbox(FACTS)
        assert sandbox.allowlist is (role.name not in {"rosmaster", "rosout", "charon"}), role.name
        assert bool(sandbox.programs) is not sandbox.allowlist
        assert (sandbox.families == UNIX) is (role.name in {"signer", "compiler", "api", "recorder", "door"})
        assert role.network or (sandbox.families, sandbox.binds, sandbox.connects) == (UNIX, (), ())


def test_a_saved_file_may_be_replaced(tmp_path: Path) -> None:
    assert folders_of(tmp_path / "policy.ini", None) == (str(tmp_path),)
    assert folders_of(Path("policy.ini")) == (str(Path.cwd()),)
    (tmp_path / "link").symlink_to("/srv/robot/policy.ini")
    assert folders_of(tmp_path / "link") == (str(tmp_path), "/srv/robot")


def test_a_program_includes_its_dynamic_linker(tmp_path: Path) -> None:
    link = tmp_path / "python"
    link.symlink_to("/usr/bin/python3")
    first, *loaders = executables_of(link)
    assert first == str(Path("/usr/bin/python3").resolve())
    assert all("ld-linux" in loader for loader in loaders)
    assert loaders
    sandbox = with_system_files(SandboxPlan(), "/s/relay", "/s/run")
    assert "/s/run" in sandbox.reads
    assert sandbox.writes == ("/s/relay", "/dev/null")
