"""A log that took the place of another one: what the signer, the log, `verify` and the operator's order make of it."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.log.log import AuditLog
from appliance.audit.log.signatures import write_public_key
from appliance.audit.proof.chain_findings import FindingKind, Verification
from appliance.audit.proof.verification import verify
from appliance.audit.search.query import Filter
from appliance.audit.search.search import search
from appliance.base import clock
from appliance.cli.audit.verification_text import print_verification
from appliance.ipsec.signed_checkpoints import MAX_LOGS, CheckpointMemory, CheckpointRefusedError
from appliance.signing.signed_logs import acknowledge, remembered_logs, sync_index
from tests.support.audit import decision, settle
from tests.support.command import rosrv
from tests.support.engines import ByHand


class Machine:
    """A log and its signer; `run` starts the appliance, records and ends it."""

    def __init__(self, state: Path) -> None:
        self.state = state
        self.path = state / "control" / "audit.db"
        self.signer = state / "signer"
        self.path.parent.mkdir(parents=True)
        self.signer.mkdir()
        self.key = Ed25519PrivateKey.generate()
        write_public_key(self.signer / "audit.pub", self.key.public_key().public_bytes_raw())

    def run(self, records: int = 10, *, others: bool = True) -> AuditLog:
        sync_index(self.signer)
        memory, public = (
            CheckpointMemory(self.signer, clock.wall_ns),
            self.key.public_key().public_bytes_raw(),
        )
        running: list[AuditLog] = []

        def sign(number: int, text: bytes, *, oldest: bool = True) -> None:
            if running:
                memory.accept(text)
                if others:
                    running[0].other_logs(memory.others(text))
                running[0].store_signature(number, self.key.sign(text), public)

        log = AuditLog(self.path, drive=ByHand, checkpoint_every=5, signer=sign)
        running.append(log)
        log.request_signatures()
        for number in range(records):
            log.record(decision(log, number))
            assert settle(log) is None
        self.replaced = log.replaced
        assert log.close() is None
        return log

    def verify(self, path: Path | None = None) -> Verification:
        return verify(path or self.path, signer=self.signer)

    def found(self) -> list[FindingKind]:
        return [finding.kind for finding in self.verify().findings]

    def log_id(self) -> str:
        return self.verify().log

    def move_away(self, name: str = "old") -> Path:
        old = self.state / name
        old.mkdir()
        for file in self.path.parent.iterdir():
            file.rename(old / file.name)
        return old / "audit.db"

    def acknowledge(self, log: str) -> None:
        [found] = [one for one in remembered_logs(self.signer) if one.log == log]
        acknowledge(self.signer, found, clock.wall_ns(), 0)

    def events(self, event: str) -> list[dict[str, Any]]:
        return [entry.record.detail for entry in search(self.path, Filter(event=event)).entries]


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    one = Machine(tmp_path / "state")
    one.run()
    assert one.verify().ok
    return one


def test_a_replaced_log_is_never_called_complete_until_an_operator_acknowledges_it(
    machine: Machine, capsys: pytest.CaptureFixture[str]
) -> None:
    first, last = machine.log_id(), remembered_logs(machine.signer)[0]
    machine.move_away()
    machine.run()
    result = machine.verify()
    assert [finding.kind for finding in result.findings] == [FindingKind.LOG_REPLACED]
    print_verification(result)
    printed = capsys.readouterr().out
    assert f"log {first} up to checkpoint {last.last}" in printed
    assert "is complete" not in printed
    assert first in (machine.replaced or "")
    machine.acknowledge(first)
    machine.run(1)
    assert machine.found() == []
    assert machine.replaced is None
    print_verification(machine.verify())
    printed = capsys.readouterr().out
    assert f"log {first} was signed before" in printed
    assert "The log is complete and unchanged." not in printed


def test_the_new_log_goes_on_from_the_last_checkpoint_of_the_old_one(machine: Machine) -> None:
    [old] = remembered_logs(machine.signer)
    machine.move_away()
    machine.run()
    [detail] = machine.events("log replaced")
    assert (detail["log"], detail["number"], detail["hash"]) == (old.log, old.last, old.hash)
    machine.run(5)
    assert len(machine.events("log replaced")) == 2  # again at each start, until it is set aside
    machine.acknowledge(old.log)
    machine.run(5)
    assert len(machine.events("log replaced")) == 2


def test_control_that_hides_the_other_log_is_found_by_root(machine: Machine) -> None:
    machine.move_away()
    machine.run(others=False)
    assert machine.events("log replaced") == []
    assert machine.found() == [FindingKind.LOG_REPLACED]


def test_an_old_log_that_returns_is_found(machine: Machine) -> None:
    first = machine.log_id()
    old = machine.move_away()
    machine.run()
    machine.acknowledge(first)
    machine.move_away("new")
    for file in old.parent.iterdir():
        shutil.copy(file, machine.path.parent / file.name)
    assert machine.found() == [FindingKind.LOG_REPLACED]  # the newer one is missing now
    machine.run()
    assert machine.found() == [FindingKind.LOG_REPLACED]


def test_an_acknowledgement_ends_when_its_log_is_written_again(machine: Machine) -> None:
    first = machine.log_id()
    old = machine.move_away()
    machine.run()
    machine.acknowledge(first)
    second = machine.log_id()
    machine.move_away("new")
    for file in old.parent.iterdir():
        shutil.copy(file, machine.path.parent / file.name)
    machine.acknowledge(second)
    assert machine.found() == []
    machine.run()
    machine.move_away("old again")
    machine.run()
    assert machine.found() == [FindingKind.LOG_REPLACED]
    assert first in machine.verify().findings[0].message


def test_a_removed_memory_is_found(machine: Machine) -> None:
    log = machine.log_id()
    (machine.signer / f"{log}.signed").unlink()
    assert machine.found() == [FindingKind.MEMORY_MISSING]
    machine.run()
    assert machine.found() == [FindingKind.MEMORY_MISSING]
    machine.acknowledge(log)
    assert machine.found() == []
    (machine.signer / f"{log}.signed").unlink()
    machine.run()
    assert machine.found() == [FindingKind.MEMORY_MISSING]


def test_the_memory_and_the_index_removed_together_are_found(machine: Machine) -> None:
    for name in (f"{machine.log_id()}.signed", "logs"):
        (machine.signer / name).unlink()
    assert machine.found() == [FindingKind.MEMORY_MISSING]


def test_a_removed_memory_of_another_log_does_not_hide_it(machine: Machine) -> None:
    first = machine.log_id()
    machine.move_away()
    machine.run()
    (machine.signer / f"{first}.signed").unlink()
    assert machine.found() == [FindingKind.LOG_REPLACED]
    assert first in machine.verify().findings[0].message


def _restored(machine: Machine, tmp_path: Path) -> Machine:
    shutil.copytree(machine.state, tmp_path / "copy")
    machine.run()
    shutil.rmtree(machine.state)
    shutil.move(tmp_path / "copy", machine.state)
    machine.run()
    return machine


def _cloned(machine: Machine, tmp_path: Path) -> Machine:
    clone = object.__new__(Machine)
    clone.__dict__ |= machine.__dict__
    shutil.copytree(machine.state, tmp_path / "clone")
    clone.state, clone.signer = tmp_path / "clone", tmp_path / "clone" / "signer"
    clone.path = clone.state / "control" / "audit.db"
    clone.run()
    return clone


def _of_a_pair(_machine: Machine, tmp_path: Path) -> Machine:
    other = Machine(tmp_path / "other")  # a log and a signer of its own
    other.run()
    return other


def _upgraded(machine: Machine, _tmp_path: Path) -> Machine:
    (machine.signer / "logs").unlink()  # an earlier version kept no index
    machine.run()
    return machine


def _crashed(machine: Machine, _tmp_path: Path) -> Machine:
    (machine.signer / "logs").write_bytes(b"[]")  # the memory was written, and the index not yet
    machine.run()
    return machine


@pytest.mark.parametrize("case", [_restored, _cloned, _of_a_pair, _upgraded, _crashed])
def test_nothing_is_replaced(
    machine: Machine, tmp_path: Path, case: Callable[[Machine, Path], Machine]
) -> None:
    one = case(machine, tmp_path)
    assert one.verify().ok
    assert one.replaced is None
    assert one.events("log replaced") == []


def test_logs_that_are_set_aside_leave_places(tmp_path: Path) -> None:
    memory = CheckpointMemory(tmp_path, clock.wall_ns)
    text = "rosrv audit checkpoint 1\nlog {}\nnumber 1\nsequence 1\nhash {}\ntime 1\nprevious {}\n"

    def accept(number: int) -> None:
        memory.accept(text.format(f"{number:032x}", "b" * 64, "0" * 64).encode())

    for number in range(MAX_LOGS):
        accept(number)
    with pytest.raises(CheckpointRefusedError, match="rosrv audit acknowledge"):
        accept(MAX_LOGS)
    acknowledge(tmp_path, remembered_logs(tmp_path)[0], 1, 0)
    accept(MAX_LOGS)


def test_the_order_on_the_machine(machine: Machine) -> None:
    def order(*words: str) -> tuple[int, str]:
        done = rosrv("audit", "acknowledge", "--state", str(machine.state), *words)
        return done.returncode, done.stdout + done.stderr

    first = machine.log_id()
    machine.move_away()
    machine.run()
    second = machine.log_id()
    status, printed = order()
    assert (status, first in printed, "missing" in printed) == (1, True, True)
    assert order("zz")[0] == 1
    assert "present log" in order(second)[1]
    assert machine.found() == [FindingKind.LOG_REPLACED]
    status, printed = order(first[:8])
    assert (status, "set aside" in printed) == (0, True)
    assert machine.found() == []
    status, printed = order("--json")
    assert [json.loads(line)["state"] for line in printed.splitlines()] == ["set aside", "present"]
    assert "nothing to acknowledge" in order(first)[1]
    assert (machine.signer / f"{first}.acknowledged").stat().st_mode & 0o777 == 0o600
