import json
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

FOLDER = Path(__file__).parents[2] / "examples" / "prometheus"


def promtool(*arguments: str, folder: Path = FOLDER) -> subprocess.CompletedProcess[str]:
    program = shutil.which("promtool")
    assert program is not None, "promtool is missing: apt install prometheus (packages-system.txt)"
    return subprocess.run(
        [program, *arguments], cwd=folder, capture_output=True, text=True, timeout=240, check=False
    )


def test_the_rules_are_valid() -> None:
    done = promtool("check", "rules", "alerts.yaml")
    assert done.returncode == 0, done.stderr
    assert "SUCCESS" in done.stdout


@pytest.mark.parametrize("name", ["rosrv", "rosrv-fleet"])
def test_a_scrape_configuration_needs_its_own_files_only(tmp_path: Path, name: str) -> None:
    file = FOLDER / f"prometheus{name.removeprefix('rosrv')}.yml"
    for path in (file, FOLDER / "alerts.yaml"):
        (tmp_path / path.name).write_text(path.read_text().replace("/etc/prometheus", str(tmp_path)))
    for end in ("token", "pem"):
        (tmp_path / f"{name}.{end}").touch()
    done = promtool("check", "config", file.name, folder=tmp_path)
    assert done.returncode == 0, done.stderr


def test_each_alert_fires_when_it_should_and_not_before() -> None:
    done = promtool("test", "rules", *(path.name for path in FOLDER.glob("alerts*.tests.yaml")))
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("was", "now"),
    [
        ("rosrv_audit_failed == 1", "rosrv_audit_failed == 2"),
        ('kind="fault"', 'kind="verdict"'),
        ("for: 1h", "for: 1m"),
        ("rosrv_process_restarts_total[10m]", "rosrv_process_restarts_total[2m]"),
    ],
)
def test_the_cases_find_a_fault(tmp_path: Path, was: str, now: str) -> None:
    rules = (FOLDER / "alerts.yaml").read_text()
    assert was in rules
    (tmp_path / "alerts.yaml").write_text(rules.replace(was, now))
    shutil.copy(FOLDER / "alerts.tests.yaml", tmp_path)
    assert promtool("test", "rules", "alerts.tests.yaml", folder=tmp_path).returncode != 0


def test_the_queries_of_the_dashboard_are_valid(tmp_path: Path) -> None:
    dashboard = json.loads((FOLDER.parent / "grafana/rosrv.json").read_text())
    queries = [target["expr"] for panel in dashboard["panels"] for target in panel.get("targets", ())]
    queries += [one["expr"] for one in dashboard["annotations"]["list"]]
    rules = [
        {"record": f"query:{number}", "expr": query.replace("$__rate_interval", "1m")}
        for number, query in enumerate(queries)
    ]
    assert len(rules) > 20
    file = tmp_path / "rules.yaml"
    file.write_text(yaml.safe_dump({"groups": [{"name": "dashboard", "rules": rules}]}))
    done = promtool("check", "rules", str(file))
    assert done.returncode == 0, done.stdout + done.stderr
