import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "from-recordings.md").read_text(encoding="utf-8")
_STEP = re.compile(r"```sh\n(?P<script>.*?)```\n```text\n(?P<shown>.*?)```\n", re.DOTALL)


def test_the_page_is_true(tmp_path: Path) -> None:
    for name in ("examples", "monitors"):
        (tmp_path / name).symlink_to(ROOT / name)
    environment = {
        **os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "COLUMNS": "200",
    }  # fmt: skip
    steps = list(_STEP.finditer(PAGE))
    assert len(steps) == PAGE.count("```sh") == 5
    for step in steps:
        script = "exec 2>&1\n" + step["script"]
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True,
            timeout=120, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout
        for line in step["shown"].splitlines():
            assert line in done.stdout, (script, done.stdout)
