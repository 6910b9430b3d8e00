import errno
import json
import os
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import pytest

from appliance.supervisor.errors import StartError
from appliance.supervisor.sandbox import private_view
from appliance.supervisor.sandbox.private_view import PrivateView, ViewError, enter, require_view, view_of
from appliance.supervisor.users import Account
from tests.support.requirements import need_root

USER: Final = 61099
_PROCESS = """
import json, os, sys
from appliance.supervisor.privileges import drop_privileges
from appliance.supervisor.sandbox.private_view import PrivateView, enter
from appliance.supervisor.users import Account

view, paths, user = json.loads(sys.argv[1]), sys.argv[2:], int(sys.argv[3])
account = Account("other", user, user)
if view is not None:
    enter(PrivateView(**view), account)
drop_privileges(account, parent=os.getppid())

def outcome(act, *arguments):
    try:
        return act(*arguments)
    except OSError as error:
        return type(error).__name__

def content(path):
    with open(path) as file:
        return file.read()

def write(path):
    with open(path, "w") as file:
        file.write("")
    return "written"

home = sys.argv[2]
print(json.dumps({
    "program": outcome(content, home + "/x y/appliance/main.py"),
    "secret": outcome(content, home + "/secret"),
    "beside": outcome(content, home + "/x y/.env"),
    "change": outcome(write, home + "/x y/appliance/main.py"),
    "state": outcome(write, home + "/state/relay/file"),
    "other state": outcome(write, home + "/state/control/file"),
    "home": outcome(lambda: sorted(os.listdir(home))),
}))
"""


@pytest.fixture
def home(tmp_path: Path) -> Path:
    need_root()
    home = tmp_path / "home"
    for folder in ("x y/appliance", "state/relay", "state/control"):
        (home / folder).mkdir(parents=True)
    for file in ("x y/appliance/main.py", "secret", "x y/.env"):
        (home / file).write_text("content")
    os.chown(home / "state/relay", USER, USER)
    for above in (tmp_path, *tmp_path.parents):
        if above.stat().st_mode & 0o077 == 0:  # pytest closes its folders to others
            above.chmod(0o711)
    for closed in ("state/relay", "state/control", "secret", "x y/.env"):
        (home / closed).chmod(0o700)
    (home / "state").chmod(0o711)
    return home


def seen(home: Path, view: PrivateView | None) -> dict[str, Any]:
    given = json.dumps(None if view is None else asdict(view))
    command = [sys.executable, "-c", _PROCESS, given, str(home), str(USER)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.nightly
@pytest.mark.parametrize("umask", [0o022, 0o027, 0o077])
@pytest.mark.parametrize("mode", [0o700, 0o750, 0o755])
def test_another_user_runs_the_program_of_a_closed_home(home: Path, mode: int, umask: int) -> None:
    home.chmod(mode)
    for path in (home / "x y", *(home / "x y").rglob("*")):
        path.chmod(path.stat().st_mode & ~umask)
    view = view_of([home / "x y/appliance"], home / "state")
    if mode == 0o755 and umask == 0o022:
        assert view is None
        return
    assert seen(home, None)["program"] == "PermissionError"
    covered = seen(home, view)
    assert covered["home"] == (["secret", "state", "x y"] if mode == 0o755 else ["state", "x y"])
    del covered["home"]
    assert covered["secret"] in {"PermissionError", "FileNotFoundError"}
    assert covered["beside"] in {"PermissionError", "FileNotFoundError"}
    assert covered | {"secret": "", "beside": ""} == {
        "program": "content",
        "secret": "",
        "beside": "",
        "change": "OSError",  # the file system is read-only
        "state": "written",
        "other state": "PermissionError",
    }
    assert (home / "x y/appliance/main.py").read_text() == "content"


@pytest.mark.nightly
def test_one_closed_file_is_enough(home: Path) -> None:
    home.chmod(0o755)
    (home / "x y/appliance/main.py").chmod(0o600)
    view = view_of([home / "x y/appliance"], home / "state")
    assert view is not None
    assert seen(home, view)["program"] == "content"


def test_without_mounts_a_closed_program_is_an_error_with_the_remedy(home: Path) -> None:
    """A container without SYS_ADMIN cannot mount; a state that is closed is reported by the process that needs it."""
    home.chmod(0o700)
    with pytest.raises(StartError, match=r"cannot read the program in .*appliance; .*chmod -R go\+rX"):
        require_view(view_of([home / "x y/appliance"], home / "state"), may_mount=False)
    assert require_view(view_of([], home / "state"), may_mount=False) is None


def test_in_a_chroot_without_a_mount_the_error_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(what: str, *_arguments: object) -> None:
        if what.startswith("mount(/"):
            raise OSError(errno.EINVAL, f"{what}: Invalid argument")

    monkeypatch.setattr(private_view, "libc_call", refused)
    with pytest.raises(ViewError, match=r"not a mount point, as in a chroot.* `mount --bind DIR DIR`"):
        enter(PrivateView(("/root",), (), (), None), Account("other", USER, USER))
