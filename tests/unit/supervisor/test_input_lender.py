import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from appliance.supervisor.input_lender import Borrower, lend_inputs
from tests.support.certificates import make_certificates
from tests.support.requirements import need_root

pytestmark = pytest.mark.nightly

USER: Final = 61099
_READ = """
import sys
from pathlib import Path
from appliance.base.input_files import read_given_text
from appliance.specifications.specification_files import read_folder
print(read_given_text(Path(sys.argv[1])), read_folder(Path(sys.argv[2])).by_name())
"""

_TLS = """
import os, sys
from pathlib import Path
from appliance.base.owner_access import FileLender
import ssl
from appliance.base.input_files import path_for_library
files = [Path(name) for name in sys.argv[1:]]
lent = {path: os.open(path, os.O_RDONLY) for path in files}
os.setresgid(61099, 61099, 61099)
os.setresuid(61099, 61099, 61099)
FileLender.install(lent.get)
context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
with path_for_library(files[0]) as ca, path_for_library(files[1]) as chain, path_for_library(files[2]) as key:
    context.load_verify_locations(ca)
    context.load_cert_chain(chain, key)
assert context.get_ca_certs()
"""


@pytest.fixture
def home(tmp_path: Path) -> Path:
    need_root()
    (tmp_path / "monitors/msg/p").mkdir(parents=True)
    for name in ("robot.ini", "robot.ini.sig", "monitors/m.rv", "monitors/msg/p/T.msg", ".ssh_key"):
        (tmp_path / name).write_text(name)
    for path in (tmp_path, *tmp_path.rglob("*")):
        os.chown(path, USER, USER)
        path.chmod(0o700 if path.is_dir() else 0o600)
    return tmp_path


@pytest.fixture
def borrower(home: Path) -> Iterator[Borrower]:
    link = lend_inputs((home / "robot.ini", home / "monitors"))
    assert link is not None
    with link:
        yield Borrower(link)


def text(descriptor: int | None) -> str:
    assert descriptor is not None
    with os.fdopen(descriptor, encoding="utf-8") as file:
        return file.read()


def test_a_role_gets_its_inputs(home: Path, borrower: Borrower) -> None:
    for name in ("robot.ini", "robot.ini.sig", "monitors/m.rv", "monitors/msg/p/T.msg"):
        assert text(borrower.open(home / name)) == name
    replaced = home / "new"
    replaced.write_text("edited")
    replaced.rename(home / "robot.ini")
    assert text(borrower.open(home / "robot.ini")) == "edited"
    with pytest.raises(FileNotFoundError):
        borrower.open(home / "robot.ini.tests.yaml")


def test_a_role_gets_nothing_else(home: Path, borrower: Borrower) -> None:
    for path in (home / ".ssh_key", home / "monitors/../.ssh_key", home, Path("/etc/shadow")):
        assert borrower.open(path) is None


def test_a_hanging_supervisor_delays_a_role_once(tmp_path: Path) -> None:
    (tmp_path / "late").write_text("late")
    ours, supervisors = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, supervisors, (tmp_path / "late").open() as late:
        borrower = Borrower(ours)
        with pytest.raises(TimeoutError):
            borrower.open(tmp_path / "late")
        ours.settimeout(None)  # a wait would hang
        with pytest.raises(TimeoutError):
            borrower.open(tmp_path / "other")
        socket.send_fds(supervisors, [bytes(4)], [late.fileno()])
        with pytest.raises(TimeoutError):
            borrower.open(tmp_path / "third")
        assert [Path(os.fsdecode(supervisors.recv(4096))).name for _ in range(2)] == ["late", "third"]


def test_a_link_cannot_lend_the_files_of_another_user(
    home: Path, borrower: Borrower, tmp_path_factory: pytest.TempPathFactory
) -> None:
    secret = tmp_path_factory.mktemp("other") / "secret"
    secret.write_text("secret")
    secret.chmod(0o600)
    secret.parent.chmod(0o700)
    (home / "monitors/x.rv").symlink_to(secret)
    (home / "monitors/msg/q").symlink_to(secret.parent)
    with pytest.raises(PermissionError):
        borrower.open(home / "monitors/x.rv")
    with pytest.raises(NotADirectoryError):
        borrower.open(home / "monitors/msg/q/secret")


def test_a_library_reads_a_copy_of_a_lent_file(tmp_path: Path) -> None:
    need_root()
    made = make_certificates(tmp_path / "closed")
    made.ca.parent.chmod(0o700)
    command = [sys.executable, "-c", _TLS, str(made.ca), str(made.certificate), str(made.key)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_root_of_a_container_reads_the_files_of_an_owner(home: Path) -> None:
    rights = "--bounding-set=-dac_override,-dac_read_search"
    files = [str(home / "robot.ini"), str(home / "monitors")]
    home.parent.chmod(0o711)
    plain = subprocess.run(["setpriv", rights, "cat", files[0]], capture_output=True, text=True, check=False)
    assert "Permission denied" in plain.stderr
    command = ["setpriv", rights, sys.executable, "-c", _READ, *files]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == "robot.ini {'m.rv': 'monitors/m.rv', 'msg/p/T.msg': 'monitors/msg/p/T.msg'}\n"
