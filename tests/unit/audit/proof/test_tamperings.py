"""Each tampering is named by `rosrv audit verify`, whose program the tampering program does not know."""

import ast
import asyncio
import shutil
from pathlib import Path
from typing import NamedTuple

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.log.log import AuditLog
from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.log.record import AuditRecord
from appliance.audit.log.signatures import write_public_key
from appliance.audit.proof.copies import SignedCheckpoint, signed_checkpoints
from appliance.audit.proof.verification import verify
from appliance.base import clock
from appliance.ipsec.signed_checkpoints import CheckpointMemory
from tests.support.audit import decision, settle
from tests.support.engines import ByHand
from tests.support.virtual_clock import VirtualClock
from tests.unit.audit.proof import tamperings

_SEGMENT = 50


class Machine(NamedTuple):
    """A state directory, an earlier copy of it, and the checkpoints that another machine keeps."""

    state: Path
    before: Path
    copies: list[SignedCheckpoint]


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Machine:
    folder = tmp_path_factory.mktemp("machine")
    with clock.using(time := VirtualClock(wall=1_800_000_000)):
        return _machine(folder, time)


def _machine(folder: Path, time: VirtualClock) -> Machine:
    state, key = folder / "state", Ed25519PrivateKey.generate()
    signer, path = state / "signer", state / "control" / "audit.db"
    for made in (path.parent, signer):
        made.mkdir(parents=True)
    (signer / "audit.key").write_bytes(key.private_bytes_raw())
    public = key.public_key().public_bytes_raw()
    write_public_key(signer / "audit.pub", public)
    memory = CheckpointMemory(signer, clock=clock.wall_ns)
    logs: list[AuditLog] = []

    def sign(number: int, text: bytes, *, oldest: bool) -> None:
        del oldest
        memory.accept(text)
        logs[-1].store_signature(number, key.sign(text), public)

    log = AuditLog(path, drive=ByHand, checkpoint_every=_SEGMENT, checkpoint_seconds=3600, signer=sign)
    logs.append(log)
    for number in range(4 * _SEGMENT):
        time.advance(1)
        if number == 66:
            _disable(log)
        log.record(decision(log, number, decision="deny", reason=f"/cmd_{number} by node {number}"))
        if number % 10 == 9:
            assert settle(log) is None
        if number == 100:
            asyncio.run(_sealed(log))
            shutil.copytree(state, folder / "before")
    log.close()
    assert verify(path, signer=signer).ok
    return Machine(state, folder / "before", signed_checkpoints(path))


async def _sealed(log: AuditLog) -> None:
    waiting = asyncio.ensure_future(log.wait_signed())
    await asyncio.sleep(0)
    assert await asyncio.wait_for(waiting, 60) is None


def _disable(log: AuditLog) -> None:
    detail = {"who": "ann", "earlier": "enabled"}
    log.record(AuditRecord(id=log.ids.next(), time=clock.wall_ns(), event="monitor disabled", detail=detail))


@pytest.fixture
def state(machine: Machine, tmp_path: Path) -> Path:
    return shutil.copytree(machine.state, tmp_path / "state")


def findings(state: Path, copies: list[SignedCheckpoint] | None = None) -> str:
    """Return the kinds of findings of `rosrv audit verify`, each from its first to its last record or checkpoint."""
    try:
        result = verify(state / "control" / "audit.db", signer=state / "signer", copies=copies)
    except LogUnreadableError:
        return "cannot be read"
    assert result.ok is (not result.findings)
    spans: dict[str, tuple[int, int]] = {}
    for finding in result.findings:
        first, last = spans.get(finding.kind, (finding.first, finding.last))
        spans[finding.kind] = min(first, finding.first), max(last, finding.last)
    ranges = (
        f"{kind} {first}" + f" to {last}" * (last > first) for kind, (first, last) in sorted(spans.items())
    )
    return ", ".join(ranges) or "-"


def test_the_list_is_long_and_its_program_knows_nothing_of_ours() -> None:
    assert len(tamperings.of_the_log) + len(tamperings.of_root) >= 50
    tree = ast.parse(Path(tamperings.__file__).read_text(encoding="utf-8"))
    imported = {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    imported |= {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    assert not any(name.startswith(("appliance", "tests")) for name in imported)


def test_an_untouched_log_has_no_finding(state: Path, machine: Machine) -> None:
    assert findings(state) == findings(state, machine.copies) == "-"


def test_each_tampering_is_named(machine: Machine, tmp_path: Path) -> None:
    """`tamperings.txt` has the findings on the machine, and those with the copies that another machine keeps."""
    told = []
    for number, (name, tampering) in enumerate({**tamperings.of_the_log, **tamperings.of_root}.items()):
        state: Path = shutil.copytree(machine.state, tmp_path / str(number))
        tampering(state, machine.before)
        here = findings(state)
        shutil.rmtree(state / "signer", ignore_errors=True)  # an auditor has the log and the copies
        elsewhere = findings(state, machine.copies)
        shutil.rmtree(state)
        assert elsewhere != "-" or (here != "-" and name not in tamperings.of_root) or "memory" in name, name
        told.append(f"{name}: {here} | {elsewhere}\n")
    assert "".join(told) == Path(__file__).with_name("tamperings.txt").read_text(encoding="utf-8")
