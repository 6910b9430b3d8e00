"""`scripts/setup` on a machine where another program installs packages."""

import os
import subprocess
from pathlib import Path

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
    """Run `scripts/setup` with an `apt-get` that fails `busy` times with this text; every package is missing."""
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
    """The script says once that it waits, and then installs the packages."""
    need_root()
    done = run_setup(
        tmp_path, busy=3, said="E: Could not get lock /var/lib/apt/lists/lock. It is held by process 9"
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("another program holds the lock of apt") == 1
    calls = (tmp_path / "calls").read_text().splitlines()
    assert [call.split()[0] for call in calls] == ["update"] * 4 + ["-o"]


def test_another_failure_of_apt_ends_it(tmp_path: Path) -> None:
    """The script prints apt-get's output and does not try again."""
    need_root()
    done = run_setup(tmp_path, busy=1, said="E: Unable to fetch some archives")
    assert done.returncode == 1
    assert "E: Unable to fetch some archives" in done.stderr
    assert (tmp_path / "calls").read_text().splitlines() == ["update -qq"]
