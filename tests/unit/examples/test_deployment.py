from pathlib import Path
from typing import Any

import yaml

from appliance.configuration.config_sources import resolve
from appliance.policy.judgement import PolicyContext, judge
from appliance.policy.policy_compiler import compile_policy

ROOT = Path(__file__).parents[3]
ROLE = ROOT / "examples/ansible/roles/rosrv"
CLOUD = ROOT / "examples/cloud-init/user-data.yaml"


def written() -> dict[str, str]:
    data: dict[str, Any] = yaml.safe_load(CLOUD.read_text())
    return {file["path"]: file["content"] for file in data["write_files"]}


def test_the_role_has_the_packages_defaults(tmp_path: Path) -> None:
    settings = yaml.safe_load((ROLE / "defaults/main.yml").read_text())["rosrv_settings"]
    assert settings == yaml.safe_load((ROOT / "distribution/appliance.yaml").read_text())


def test_the_role_checks_before_it_writes() -> None:
    tasks = {task["name"]: task for task in yaml.safe_load((ROLE / "tasks/main.yml").read_text())}
    handlers = {handler["name"] for handler in yaml.safe_load((ROLE / "handlers/main.yml").read_text())}
    placed = [task for task in tasks.values() if "/etc/rosrv" in str(task.get("ansible.builtin.copy"))]
    assert len(placed) == 2
    for task in placed:
        assert task["ansible.builtin.copy"]["validate"].startswith("rosrv ")
        assert task["notify"] in handlers


def test_cloud_init_writes_valid_files(tmp_path: Path) -> None:
    files = written()
    policy = compile_policy(files["/etc/rosrv/policies/robot.ini"], file="robot.ini")
    assert list(policy.warnings) == []
    configuration = tmp_path / "appliance.yaml"
    configuration.write_text(files["/etc/rosrv/appliance.yaml"])
    assert resolve(configuration, {}, {}).policy == tmp_path / "policies/robot.ini"


def test_cloud_init_checks_the_package() -> None:
    steps = yaml.safe_load(CLOUD.read_text())["runcmd"]
    assert steps[0] == "set -e", "cloud-init makes one script of them"
    order = [
        next(i for i, step in enumerate(steps) if word in step) for word in ("curl", "sha256sum", "apt-get")
    ]
    assert order == sorted(order)
    assert f'"{"0" * 64}  /var/cache/rosrv.deb"' in steps[order[1]]


def test_the_lines_of_the_demonstration_can_be_removed() -> None:
    file = ROOT / "policies/containers.ini"
    cases = file.with_name("containers.ini.tests.yaml").read_text()
    script = "sed -i '/# demo/d; s/ tablet//' "
    assert f"    {script}policies/containers.ini\n" in (ROOT / "docs/install.md").read_text()
    kept = [line for line in file.read_text().splitlines() if "# demo" not in line]
    without = "\n".join(line.replace(" tablet", "", 1) for line in kept)
    rules = "\n".join(line for line in without.splitlines() if not line.startswith("#"))
    assert "landshark" not in rules and "tablet" not in rules
    for text in (file.read_text(), without):
        judge(text, "containers.ini", PolicyContext(cases_file="cases", cases=cases)).accept()
