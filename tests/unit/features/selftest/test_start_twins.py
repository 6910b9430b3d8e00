"""Each reason for which the appliance does not start is one that `rosrv selftest` checks, or is reviewed here."""

import ast
from pathlib import Path
from typing import Any

import pytest

from appliance.configuration.settings import Settings
from appliance.features.selftest import file_checks, machine_checks
from appliance.network.namespaces import read_only_settings
from appliance.supervisor.restore_mark import set_mark
from appliance.supervisor.roles import ROS_PROGRAMS
from distribution.fact_cache import functions, statements

ROOT = Path(__file__).parents[4] / "appliance"
TWINS = {
    "supervisor/sandbox/private_view.py:require_view": "reviewed: it depends on the folder from which `up` is run",
    "supervisor/isolation_lifecycle.py:build": {"namespaces", "sysctl", "veth", "firewall"},
    "supervisor/isolation_lifecycle.py:_require_own_network": {"network"},
    "supervisor/restore_mark.py:refuse_half_restored": {"restore"},
    "supervisor/state_directory.py:__init__": {"state"},
    "supervisor/state_directory.py:prepare": {"state", "users"},
    "supervisor/state_directory.py:open_admin_socket": "reviewed: the path is too long, which the message says",
    "supervisor/state_directory.py:_take_lock": "reviewed: the other appliance answers selftest itself",
    "supervisor/state_directory.py:_folder": {"state"},
    "supervisor/supervisor.py:run": "reviewed: a process that dies later; `rosrv status` has its last output",
    "supervisor/port_check.py:require_free": {"port of "},
    "supervisor/port_check.py:spare_ports": "reviewed: `[Ports]` leaves no room, which the message says",
    "supervisor/run.py:run_appliance": {"kernel"},
    "supervisor/roles.py:require_programs": {"programs"},
    "features/standby/pairing.py:pairing_in": {"pair"},
    "features/recorder/rings.py:__init__": "reviewed: the free memory differs at each start",
    "cli/up_inputs.py:read_inputs": {"policy"},
    "cli/up_inputs.py:read_node_ports": {"policy"},
    "cli/up_inputs.py:_require_specifications": {"monitors"},
    "cli/up.py:_keep_token": {"state", "space"},
}


def raised() -> set[str]:
    """Return the functions that raise `StartError`."""
    found: set[str] = set()
    for file in ROOT.rglob("*.py"):
        text = file.read_text()
        for function in functions(ast.parse(text if "StartError" in text else "")):
            calls = (statement.exc for statement in statements(function) if isinstance(statement, ast.Raise))
            names = [getattr(call.func, "id", "") for call in calls if isinstance(call, ast.Call)]
            found |= {f"{file.relative_to(ROOT)}:{function.name}"} if "StartError" in names else set()
    return found


def checks() -> set[str]:
    """Return the names of the checks, as `run_check`, `ok`, `warn` and `fail` give them."""
    found: set[str] = set()
    for module in (file_checks, machine_checks):
        for node in ast.walk(ast.parse(Path(str(module.__file__)).read_text())):
            if isinstance(node, ast.Call) and node.args:
                first = node.args[0]
                if isinstance(first, ast.JoinedStr):
                    first = first.values[0]
                if isinstance(first, ast.Constant) and isinstance(first.value, str):
                    found.add(first.value)
    return found


def test_each_reason_not_to_start_has_its_check() -> None:
    assert raised() == set(TWINS), "add the check to `rosrv selftest`, or the reason why it has none"
    named = {name for one in TWINS.values() if isinstance(one, set) for name in one}
    assert named - checks() == set()


@pytest.mark.parametrize("missing", [(), ("ip_forward",), ("ip_forward", "route_localnet")])
def test_a_setting_of_the_kernel_that_cannot_be_written_fails(
    tmp_path: Path, missing: tuple[str, ...]
) -> None:
    for key in ("ip_forward", "conf/default/route_localnet"):
        path = tmp_path / "net/ipv4" / key
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.name not in missing:
            path.write_text("0")
    (found,) = machine_checks.kernel_settings(read_only_settings(tmp_path))
    assert found.outcome == ("fail" if missing else "ok")
    assert all(name in found.text for name in missing)


@pytest.mark.parametrize("name", sorted(path.name for path in ROS_PROGRAMS))
def test_a_program_without_which_nothing_starts_is_a_failure(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shutil.which", lambda _name: None)
    monkeypatch.setattr(Path, "exists", lambda _path: False)
    found = {program.check: program.outcome for program in machine_checks.programs()}
    assert found[name] == "fail"


def test_a_restore_that_did_not_finish_fails(tmp_path: Path) -> None:
    set_mark(tmp_path)
    assert [one.outcome for one in file_checks.unfinished_restore(tmp_path)] == ["fail"]


def test_a_membership_that_cannot_be_read_fails(tmp_path: Path) -> None:
    assert list(file_checks.membership(tmp_path)) == []
    (tmp_path / "standby").mkdir()
    (tmp_path / "standby" / "membership.json").write_text("{")
    assert [one.outcome for one in file_checks.membership(tmp_path)] == ["fail"]


def test_a_container_that_shares_the_network_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine_checks, "shared_network", lambda: "it shares the network")
    monkeypatch.setattr("os.geteuid", lambda: 1)
    settings: Any = Settings(isolation="container")
    assert "fail" in [one.outcome for one in machine_checks.kernel(settings) if one.check == "network"]
