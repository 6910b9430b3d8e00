"""Each reason for which the appliance does not start is one that `rosrv selftest` checks, or is reviewed here."""

import ast
import datetime
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from appliance.api.front.certificate import tls_context
from appliance.base import clock
from appliance.cli.main import app
from appliance.configuration.settings import Settings
from appliance.features.selftest import file_checks, machine_checks
from appliance.ipsec.certificate_authority import CertificateAuthority
from appliance.network.namespaces import read_only_settings
from appliance.supervisor.restore_mark import set_mark
from appliance.supervisor.roles import ROS_PROGRAMS
from appliance.supervisor.state_directory import StateDirectory
from distribution.fact_cache import functions, statements
from tests.support.certificates import self_signed

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
    named = {name for twin in TWINS.values() if isinstance(twin, set) for name in twin}
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
    assert [finding.outcome for finding in file_checks.unfinished_restore(tmp_path)] == ["fail"]


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


@pytest.mark.parametrize("harm", ["damaged", "expired"])
@pytest.mark.parametrize("name", ["api/certificate.pem", "signer/ca.pem"])
def test_the_appliance_starts_after_the_advice_about_a_certificate(
    tmp_path: Path, name: str, harm: str
) -> None:
    def start() -> None:
        StateDirectory(tmp_path).close()
        (tmp_path / "signer").mkdir(exist_ok=True)
        (tmp_path / "api").mkdir(exist_ok=True)
        CertificateAuthority(tmp_path / "signer")
        tls_context(tmp_path / "api", [], clock.utc_now())

    start()
    if harm == "damaged":
        (tmp_path / name).write_bytes(bytes(600))
    else:
        ended = clock.utc_now() - datetime.timedelta(days=1)
        self_signed(tmp_path / name, "127.0.0.1", ended - datetime.timedelta(days=1), ended)
    [found] = [one for one in file_checks.certificates(tmp_path) if one.outcome == "fail"]
    if "remove it" in found.advice:
        (tmp_path / name).unlink()
    else:
        done = CliRunner().invoke(app, ["host", "authority", "rotate", "--state", str(tmp_path), "--yes"])
        assert (done.exit_code, "host authority rotate" in found.advice) == (0, True), done.output
    start()
    assert {certificate.outcome for certificate in file_checks.certificates(tmp_path)} == {"ok"}
