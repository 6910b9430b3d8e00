import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.support.requirements import need_root

_REPOSITORY = Path(__file__).parents[2]
_APT = """\
#!/bin/sh
echo "$@" >> "$FOLDER/calls"
case "$*" in *update*) ;; *) exit 0 ;; esac
[ "$(grep -c update "$FOLDER/calls")" -gt "$BUSY" ] && exit 0
echo "$SAID" >&2
exit 100
"""


def run_setup(folder: Path, *, busy: int, said: str) -> subprocess.CompletedProcess[str]:
    for name, text in (("apt-get", _APT), ("dpkg-query", "#!/bin/sh\n"), ("sleep", "#!/bin/sh\n")):
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
    environment = os.environ | {"PATH": f"{folder}:{os.environ['PATH']}", "FOLDER": str(folder)}
    return subprocess.run(
        [_REPOSITORY / "scripts" / "setup"],
        env=environment | {"BUSY": str(busy), "SAID": said},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_it_waits_for_the_lock_of_apt(tmp_path: Path) -> None:
    need_root()
    done = run_setup(
        tmp_path, busy=3, said="E: Could not get lock /var/lib/apt/lists/lock. It is held by process 9"
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("another program holds the lock of apt") == 1
    calls = (tmp_path / "calls").read_text().splitlines()
    assert [call.split()[0] for call in calls] == ["update"] * 4 + ["-o"]


def test_another_failure_of_apt_ends_it(tmp_path: Path) -> None:
    need_root()
    done = run_setup(tmp_path, busy=1, said="E: Unable to fetch some archives")
    assert done.returncode == 1
    assert "E: Unable to fetch some archives" in done.stderr
    assert (tmp_path / "calls").read_text().splitlines() == ["update -qq"]


def test_it_does_not_begin_without_space(tmp_path: Path) -> None:
    (tmp_path / "df").write_text("#!/bin/sh\necho Avail; echo ' 12'\n")
    (tmp_path / "df").chmod(0o755)
    done = run_setup(tmp_path, busy=0, said="")
    assert done.returncode == 1
    assert "has 12 MB free" in done.stderr
    assert "TMPDIR=/var/tmp" in done.stderr
    assert not (tmp_path / "calls").exists()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    folder = tmp_path / "a checkout"
    for name in ("scripts/setup", "pyproject.toml", "appliance/__init__.py"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(_REPOSITORY / name, folder / name)
    for lock in _REPOSITORY.glob("requirements*.lock"):
        shutil.copy(lock, folder)
    (folder / "packages.txt").touch()
    (folder / "packages-develop.txt").touch()
    (folder / ".venv/lib/python3.11/site-packages").mkdir(parents=True)
    programs = {
        "pip": f'echo "WARNING: of pip"; echo "pip 23 from {folder}/.venv/lib"',
        "uv": 'echo "WARNING: of uv"; echo "$*" >> calls; ! [ -e broken ]',
    }
    (folder / ".venv/bin").mkdir()
    for name in ("pip", "uv", "python", "rosrv"):
        (folder / ".venv/bin" / name).write_text(f"#!/bin/sh\n{programs.get(name, 'true')}\n")
        (folder / ".venv/bin" / name).chmod(0o755)
    return folder


def set_up(checkout: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [str(checkout / "scripts/setup"), *options]
    return subprocess.run(command, capture_output=True, text=True, umask=0o077, timeout=60, check=False)


def test_it_does_nothing_twice(checkout: Path) -> None:
    done = set_up(checkout)
    assert (done.returncode, "WARNING" in done.stderr, "ready in" in done.stderr) == (0, False, True)
    calls = (checkout / "calls").read_text()
    (checkout.parent / "link").symlink_to(checkout)
    assert [set_up(checkout.parent / "link", option).stderr for option in ("--run", "--run")] == ["", ""]
    assert (checkout / "calls").read_text() == calls
    assert (checkout / ".venv/.setup-stamp").stat().st_mode & 0o777 == 0o644


def test_the_demo_keeps_the_packages_of_a_developer(checkout: Path) -> None:
    set_up(checkout)
    with (checkout / "pyproject.toml").open("a") as project:
        project.write("# changed\n")
    (checkout / "calls").unlink()
    assert set_up(checkout, "--run").returncode == 0
    assert [line.split()[1] for line in (checkout / "calls").read_text().splitlines()] == ["install"] * 2


def test_a_failure_prints_the_whole_output(checkout: Path) -> None:
    (checkout / "broken").touch()
    done = set_up(checkout)
    assert (done.returncode, "this command failed: .venv/bin/uv pip sync" in done.stderr) == (1, True)
    assert "WARNING: of uv" in done.stderr
    (checkout / "broken").unlink()
    assert "ready in" in set_up(checkout).stderr
