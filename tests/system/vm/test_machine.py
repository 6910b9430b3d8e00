"""Promises that no namespace can show. Each test runs tests *in* the machine, with Debian's own kernel."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.counting_machine import CountingMachine
from tests.support.machine import Machine
from tests.support.machine_disk import ROOT

HERE = "tests/system/vm"
PLUGINS = ("env", "PYTEST_DISABLE_PLUGIN_AUTOLOAD=1")
# Without other load no test takes two minutes; with emulation and load, ten were not enough.
SECONDS = 1500.0
COUNTING_SECONDS = 1800.0  # of this machine's clock, for minutes of one of its processors

pytestmark = pytest.mark.timeout(2400)  # the first one makes the machine's disk


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    with Machine(tmp_path_factory.mktemp("machine")) as one:
        yield one
        assert one.stop(), f"it was not shut down cleanly\n{one.story()}"


def passes(machine: Machine, *what: str, patience: float | None = None) -> str:
    done = machine.run(
        *(*PLUGINS, f"{ROOT}/.venv/bin/pytest", "-p", "pytest_timeout", "-p", "no:cacheprovider", "--quiet"),
        *("--durations=5", "-o", f"timeout={SECONDS:.0f}", *what),
        seconds=SECONDS,
        check=False,
        patience=patience,
    )
    assert done.status == 0, f"in the machine ({done.seconds:.0f} s):\n{done.output}"
    summary = done.output.strip().splitlines()[-1]
    assert "passed" in summary, summary
    assert "skipped" not in summary, done.output
    return done.output


def test_the_kernels_esp(machine: Machine) -> None:
    passes(machine, f"{HERE}/inside_kernel_esp.py")


def test_the_appliance_on_a_machine(machine: Machine) -> None:
    passes(machine, f"{HERE}/inside_whole_machine.py", "-k", "appliance")


def test_the_kit_on_a_machine(machine: Machine) -> None:
    passes(machine, f"{HERE}/inside_whole_machine.py", "-k", "joins")


def test_the_firewall_in_debians_kernel(machine: Machine) -> None:
    passes(machine, "tests/system/network/test_firewall.py", "-k", "tunnelled_host or only_control")


def test_a_takeover_through_the_kernels_esp(tmp_path: Path) -> None:
    with CountingMachine(tmp_path) as machine:
        output = passes(machine, f"{HERE}/inside_takeover.py", "--capture=no", patience=COUNTING_SECONDS)
        print(next(line for line in output.splitlines() if "until messages arrived" in line))  # noqa: T201  for the reader of the run
        assert machine.stop(), f"it was not shut down cleanly\n{machine.story()}"


def test_the_machine_is_alone(machine: Machine) -> None:
    assert machine.run("uname", "-r").output.strip().endswith("cloud-amd64")
    assert machine.run("ls", "/sys/class/net").output.split() == ["lo"]
