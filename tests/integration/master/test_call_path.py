import re
import subprocess
import sys
from pathlib import Path

from tests.support.nodes import has_ros
from tests.support.own_namespace import own_loopback
from tests.support.requirements import need_root, needs
from tests.support.sources import ROOT


def test_the_path_of_a_call_is_the_one_on_the_page(tmp_path: Path) -> None:
    need_root()
    needs(has_ros(), "ROS 1 (run `make setup`)")
    page = (ROOT / "docs/dev/architecture.md").read_text()
    [rows] = re.findall(
        r"^## The path of one registerPublisher\n.*?^\|(.*?)^`", page, re.DOTALL | re.MULTILINE
    )
    program = [sys.executable, "-m", "tests.support.call_path", str(tmp_path)]
    with own_loopback():
        done = subprocess.run(program, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert sorted(re.findall(r"^[\w/]+\.py$", done.stdout, re.MULTILINE)) == sorted(re.findall(r"`([\w/]+\.py)`", rows)), done.stdout
