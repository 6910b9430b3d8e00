"""The attacker is root on one appliance, with its signing key and signer's memory: each forged log is valid alone."""

import re
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.log.signatures import pinned_key_path, write_public_key
from appliance.audit.proof.verification import verify
from appliance.features.standby.membership import path_of, save_membership
from appliance.features.standby.takeover_table import (
    PairVerification,
    TakeoverFindingKind,
    VerifiedLog,
    verify_takeovers,
)
from appliance.signing.log_proof import parse_checkpoint
from tests.support.audit import decision
from tests.support.command import rosrv
from tests.support.features.standby.appliance_pair import Member, Story, World, four_takeovers, play
from tests.support.features.standby.standby_site import memberships
from tests.support.forgery import write_anew

# ruff: noqa: S608  the attacker's statements are built from fixed words

Kind = TakeoverFindingKind


class Pair(NamedTuple):
    a: Path
    b: Path
    key_a: Ed25519PrivateKey
    key_b: Ed25519PrivateKey

    def forge_a(self, change: str) -> None:
        write_anew(self.a, self.key_a, self.a.parent / "signer", change)

    def forge_b(self, change: str) -> None:
        write_anew(self.b, self.key_b, self.b.parent / "signer", change)


def build(folder: Path, story: Story) -> Pair:
    a, b = play(folder, story)
    return Pair(a.path, b.path, a.key, b.key)


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Pair:
    return build(tmp_path_factory.mktemp("honest"), four_takeovers)


@pytest.fixture
def pair(honest: Pair, tmp_path: Path) -> Pair:
    for name, path in (("a", honest.a), ("b", honest.b)):
        shutil.copytree(path.parent.parent, tmp_path / name)
    return honest._replace(a=tmp_path / "a/control/audit.db", b=tmp_path / "b/control/audit.db")


def verified(a: Path, b: Path) -> PairVerification:
    pair = verify_takeovers(VerifiedLog(a, verify(a)), VerifiedLog(b, verify(b)))
    assert pair.ok == (not pair.findings and all(log.ok for log in pair.logs))
    return pair


def found(pair: Pair) -> list[tuple[Kind, int]]:
    result = verified(pair.a, pair.b)
    assert [log.findings for log in result.logs] == [[], []]
    turned = verified(pair.b, pair.a)  # the order of the logs does not matter
    assert sorted(turned.findings, key=str) == sorted(result.findings, key=str)
    return [(finding.kind, finding.epoch) for finding in result.findings]


def read(path: Path, query: str) -> list[Any]:
    with closing(sqlite3.connect(path)) as connection:
        return connection.execute(query).fetchall()


def execute(path: Path, *statements: str) -> None:
    with closing(sqlite3.connect(path)) as connection:
        for statement in statements:
            connection.execute(statement)
        connection.commit()


def setting(field: str, value: str, epoch: int, event: str = "took over") -> str:
    return (
        f"UPDATE record SET detail = CAST(json_set(CAST(detail AS TEXT), '$.{field}', {value}) AS BLOB)"
        f" WHERE event = '{event}' AND json_extract(CAST(detail AS TEXT), '$.epoch') = {epoch}"
    )


def removing(epoch: int) -> str:
    return f"DELETE FROM record WHERE event = 'took over' AND CAST(detail AS TEXT) LIKE '%\"epoch\":{epoch}%'"


def loosening(table: str) -> tuple[str, ...]:
    """Return the statements that leave a table without its constraints."""
    copy = f"CREATE TABLE loose AS SELECT * FROM {table}"
    return copy, f"DROP TABLE {table}", f"ALTER TABLE loose RENAME TO {table}"


# --- an honest pair -----------------------------------------------------------------------------------------------


def test_an_honest_pair_is_proven(pair: Pair) -> None:
    result = verified(pair.a, pair.b)
    assert result.ok, result.findings
    rows = [(one.epoch, one.appliance, one.other, one.link, one.overlap) for one in result.takeovers]
    assert rows == [
        (1, "a", "b", "none", "unknown"),
        (2, "b", "a", "proven", "excluded"),
        (4, "a", "b", "proven", "excluded"),
        (5, "b", "a", "proven", "unknown"),
    ]


def test_a_standby_that_was_never_active_has_no_log(pair: Pair, tmp_path: Path) -> None:
    async def first_hour(a: Member, _b: Member, _world: World) -> None:
        async with a.active(1):
            await a.decide(3, 10)

    fresh = build(tmp_path / "fresh", first_hour)
    for log, findings in ((fresh.a, []), (pair.a, [(Kind.LOG_MISSING, 4)])):
        result = verify_takeovers(VerifiedLog(log, verify(log)), absent="b")
        assert [(finding.kind, finding.epoch) for finding in result.findings] == findings
        assert result.ok is not bool(findings)
    states = fresh.a.parents[1], fresh.b.parents[1]
    fresh.b.unlink()
    command = "audit", "verify", "--state", str(states[0]), "--other", str(states[1])
    assert rosrv(*command).returncode == 2  # a wrong directory
    save_membership(path_of(states[1]), memberships(tmp_path)[0]["b"])
    done = rosrv(*command)
    assert (done.returncode, done.stdout.splitlines()[-1]) == (
        0, "b has no log yet, because it was never active: there is no takeover to verify.",
    )  # fmt: skip


def test_the_tail_is_counted(pair: Pair) -> None:
    second, third = verified(pair.a, pair.b).takeovers[1:3]
    ((next_takeover,),) = read(pair.a, "SELECT max(sequence) FROM record WHERE event = 'took over'")
    assert second.tail == next_takeover - 1 - second.through >= 5
    assert second.tail_signed == second.tail
    ((handed_over,),) = read(pair.b, "SELECT sequence FROM record WHERE event = 'handed over'")
    assert third.through == handed_over
    assert third.tail <= 1  # the record of the checkpoint itself


def test_signatures_before_the_named_checkpoint_seal_no_tail(pair: Pair) -> None:
    lost = msgspec.structs.replace(verify(pair.a), signed_through=3)
    result = verify_takeovers(VerifiedLog(pair.a, lost), VerifiedLog(pair.b, verify(pair.b)))
    assert [takeover.tail_signed for takeover in result.takeovers if takeover.other == "a"] == [0, 0]


def test_an_unsigned_tail_is_counted(tmp_path: Path) -> None:
    async def story(a: Member, b: Member, world: World) -> None:
        async with a.active(1):
            await a.decide(3, 3)
            await a.sealed()
            a.replicate_to(b)
            await a.decide(4, 3)
        world.passes(3)
        async with b.active(2):
            await b.decide(3, 3)
            await b.sealed()

    made = build(tmp_path, story)
    result = verified(made.a, made.b)
    assert result.ok
    assert result.takeovers[1].tail >= 4
    assert result.takeovers[1].tail_signed == 0


def begun_after(path: Path, removed: int) -> VerifiedLog:
    result = msgspec.structs.replace(verify(path), removed=removed)
    execute(path, f"DELETE FROM record WHERE sequence <= {removed}")
    return VerifiedLog(path, result)


def test_retention_leaves_the_rest_proven(pair: Pair) -> None:
    first = verified(pair.a, pair.b).takeovers[1]
    result = verify_takeovers(begun_after(pair.a, first.through), VerifiedLog(pair.b, verify(pair.b)))
    assert result.ok, result.findings
    links = [(takeover.epoch, takeover.link) for takeover in result.takeovers]
    assert links == [(2, "removed"), (4, "proven"), (5, "proven")]


def test_a_takeover_removed_by_retention_is_not_missing(pair: Pair) -> None:
    pair.forge_b(setting("previous", 'json(\'{"epoch": 3, "appliance": "a"}\')', 5))
    assert found(pair) == [(Kind.TAKEOVER_MISSING, 3)]
    b = VerifiedLog(pair.b, verify(pair.b))
    within = verify_takeovers(begun_after(pair.a, 1), b)
    assert [(finding.kind, finding.epoch) for finding in within.findings] == [(Kind.TAKEOVER_MISSING, 3)]
    ((place,),) = read(pair.a, "SELECT max(sequence) FROM record WHERE event = 'took over'")
    assert verify_takeovers(begun_after(pair.a, place - 1), b).findings == []
    assert verify_takeovers(begun_after(pair.a, place), b).findings == []


def test_records_after_the_verified_part_are_not_read(pair: Pair) -> None:
    result = verify(pair.b)
    ((place,),) = read(pair.b, "SELECT max(sequence) FROM record WHERE event = 'took over'")
    part = msgspec.structs.replace(result, last=place - 1)
    epochs = [
        one.epoch
        for one in verify_takeovers(VerifiedLog(pair.a, verify(pair.a)), VerifiedLog(pair.b, part)).takeovers
    ]
    assert epochs == [1, 2, 4]


def test_the_tail_reaches_beyond_an_unsealed_takeover(tmp_path: Path) -> None:
    async def story(a: Member, b: Member, world: World) -> None:
        async with a.active(1):
            a.replicate_to(b)
        a.silence()
        async with a.active(2, sealed=False):
            await a.decide(5, 5)
        world.passes(3)
        async with b.active(3):
            await b.decide(3, 3)

    made = build(tmp_path, story)
    result = verified(made.a, made.b)
    assert result.ok, result.findings
    last = result.takeovers[-1]
    assert last.tail == result.logs[0].last - last.through > 5
    assert last.tail_signed == 0


def test_the_findings_are_limited(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    pair.forge_b(removing(2))
    assert len(verified(pair.a, pair.b).findings) > 1
    monkeypatch.setattr("appliance.features.standby.takeover_table._MAX_FINDINGS", 1)
    assert len(verified(pair.a, pair.b).findings) == 1


def test_logs_without_a_takeover_have_no_link(tmp_path: Path) -> None:
    async def story(a: Member, b: Member, _world: World) -> None:
        await a.decide(3, 3)
        await b.decide(3, 3)

    made = build(tmp_path, story)
    result = verified(made.a, made.b)
    assert result.ok
    assert result.takeovers == []


# --- tampering ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "findings"),
    [
        ("UPDATE record SET decision = 'deny' WHERE sequence = 5", [(Kind.REWRITTEN, 4)]),
        ("UPDATE record SET time = time - 1 WHERE sequence = 5", [(Kind.REWRITTEN, 4)]),
        ("UPDATE record SET host = '10.0.0.99' WHERE sequence = 5", [(Kind.REWRITTEN, 4)]),
        (setting("previous", """json('{"epoch": 3, "appliance": "b"}')""", 5), [(Kind.TAKEOVER_MISSING, 3)]),
        (setting("previous.epoch", "5", 5), [(Kind.EPOCH_ORDER, 5)]),
        (setting("checkpoint.signature", "'" + "00" * 64 + "'", 5), [(Kind.SIGNATURE_WRONG, 5)]),
        (setting("checkpoint.hash", "'" + "00" * 32 + "'", 5), [(Kind.SIGNATURE_WRONG, 5)]),
    ],
)
def test_a_forged_log(pair: Pair, change: str, findings: list[Any]) -> None:
    pair.forge_b(change)
    assert found(pair) == findings


@pytest.mark.parametrize(
    ("change", "finding", "message"),
    [
        (removing(2), (Kind.TAKEOVER_MISSING, 2), ""),
        (setting("other", "'c'", 5), (Kind.WRONG_NAME, 5), ""),
        (setting("appliance", "'a'", 5), (Kind.WRONG_NAME, 5), ""),
        (setting("epoch", "-1", 5), (Kind.UNREADABLE, 0), ""),
        (setting("epoch", "'five'", 5), (Kind.UNREADABLE, 0), ""),
        (setting("epoch", "9223372036854775808.5", 5), (Kind.UNREADABLE, 0), ""),
        (setting("epoch", "2", 5), (Kind.EPOCH_ORDER, 2), "^epoch 2: record .* comes after epoch 2"),
        (setting("epoch", "3", 5), (Kind.EPOCH_ORDER, 3), "seals the takeover of epoch 4"),
        (setting("epoch", "1", 2, "handed over"), (Kind.EPOCH_ORDER, 1), "hands it over to"),
        (setting("to", "'c'", 2, "handed over"), (Kind.EPOCH_ORDER, 2), "hands it over to"),
    ],
)
def test_a_forged_takeover(pair: Pair, change: str, finding: tuple[Kind, int], message: str) -> None:
    pair.forge_b(change)
    assert finding in found(pair)
    assert any(re.search(message, one.message) for one in verified(pair.a, pair.b).findings)


@pytest.mark.parametrize(
    ("epoch", "message"),
    [
        ("1", "^epoch 1: record .* comes after epoch 2"),
        ("4", "^epoch 4: both logs have a takeover of epoch 4$"),
    ],
)
def test_a_takeover_with_an_epoch_of_another_one(pair: Pair, epoch: str, message: str) -> None:
    pair.forge_b(setting("epoch", epoch, 5))
    assert any(re.search(message, finding.message) for finding in verified(pair.a, pair.b).findings)


def test_a_removed_decision(pair: Pair) -> None:
    pair.forge_a("DELETE FROM record WHERE sequence = 6")
    assert found(pair) == [(Kind.REWRITTEN, 2), (Kind.REWRITTEN, 5)]


def test_a_cut_log(pair: Pair) -> None:
    third = verified(pair.a, pair.b).takeovers[2]
    execute(
        pair.b,
        f"DELETE FROM record WHERE sequence >= {third.through}",
        f"DELETE FROM checkpoint WHERE sequence >= {third.through}",
    )
    assert found(pair) == [(Kind.TRUNCATED, 4)]


def test_a_missing_log(pair: Pair) -> None:
    result = verify(pair.b)
    pair.b.unlink()
    with pytest.raises(LogUnreadableError, match=str(pair.b)):
        verify_takeovers(VerifiedLog(pair.a, verify(pair.a)), VerifiedLog(pair.b, result))


def test_a_log_of_another_pair(pair: Pair, tmp_path: Path) -> None:
    stranger = build(tmp_path / "stranger", four_takeovers)
    kinds = found(pair._replace(b=stranger.b))
    assert (Kind.LOG_REPLACED, 4) in kinds
    assert (Kind.LOG_REPLACED, 2) in kinds


def test_one_log_given_twice(pair: Pair) -> None:
    assert found(pair._replace(b=pair.a)) == [(Kind.SAME_LOG, 0)]


def test_a_log_signed_with_another_key(pair: Pair) -> None:
    key = Ed25519PrivateKey.generate()
    write_anew(pair.b, key, pair.b.parent / "signer", "UPDATE record SET reason = reason")
    write_public_key(pinned_key_path(pair.b), key.public_key().public_bytes_raw())
    assert found(pair) == [(Kind.WRONG_KEY, 4)]


def test_a_different_checkpoint_with_the_same_hash(pair: Pair) -> None:
    number, sequence, text = read(pair.a, "SELECT number, sequence, text FROM checkpoint ORDER BY number")[-2]
    named = verified(pair.a, pair.b).takeovers[-1]
    assert sequence == named.through
    changed = parse_checkpoint(text)._replace(time=1).text()
    with closing(sqlite3.connect(pair.a)) as connection:
        connection.execute(
            "UPDATE checkpoint SET text = ?, signature = ? WHERE number = ?",
            (changed, pair.key_a.sign(changed), number),
        )
        connection.execute("DELETE FROM checkpoint WHERE number > ?", (number,))
        connection.commit()
    findings = [(finding.kind, finding.epoch) for finding in verified(pair.a, pair.b).findings]
    assert findings == [(Kind.CHECKPOINT_CHANGED, 5)]


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE record SET time = 'noon' WHERE event = 'took over'",
        "UPDATE record SET time = NULL WHERE event = 'decision'",
        "UPDATE record SET hash = 5000000000000",
        "UPDATE checkpoint SET text = 7",
        "ALTER TABLE record DROP COLUMN time",
        "DROP TABLE checkpoint",
    ],
)
def test_a_replaced_table(pair: Pair, statement: str) -> None:
    execute(pair.a, *loosening("record"), *loosening("checkpoint"), statement)
    result = verified(pair.a, pair.b)
    assert not result.ok
    assert not result.logs[0].ok


def test_a_log_that_changes_after_its_verification(pair: Pair) -> None:
    results = VerifiedLog(pair.a, verify(pair.a)), VerifiedLog(pair.b, verify(pair.b))
    execute(pair.a, *loosening("record"), "UPDATE record SET hash = 7")
    found_now = verify_takeovers(*results).findings
    assert [(one.kind, one.epoch) for one in found_now] == [(Kind.REWRITTEN, 2), (Kind.REWRITTEN, 5)]


@pytest.mark.parametrize("side", ["a", "b"])
def test_a_fault_of_either_log_is_one_of_the_pair(pair: Pair, side: str) -> None:
    execute(getattr(pair, side), "UPDATE record SET reason = 'x' WHERE sequence = 3")
    assert not verified(pair.a, pair.b).ok


def test_an_older_copy(pair: Pair, tmp_path: Path) -> None:
    shutil.copytree(pair.b.parent, tmp_path / "older")
    older = pair._replace(b=tmp_path / "older" / "audit.db")
    execute(older.b, "DELETE FROM record WHERE sequence > 3", "DELETE FROM checkpoint WHERE sequence > 3")
    assert (Kind.TRUNCATED, 4) in found(older)


# --- overlapping epochs -------------------------------------------------------------------------------------------


def overlapping(folder: Path, both: float, *, lasting: float = 60, clock_set: str = "") -> Pair:
    async def story(a: Member, b: Member, world: World) -> None:
        async with a.active(1):
            await a.decide(5, 5)
            await a.sealed()
            a.replicate_to(b)
        async with b.active(2):
            if both:
                await a.decide(1, both)
            world.passes(1)
            if clock_set:
                (a if clock_set == "a" else b).trail.happened("clock set forward", "by a person", seconds=9)
            await b.decide(5, lasting)
            await b.sealed()
        b.replicate_to(a)
        async with a.active(3):
            await a.decide(2, 2)
            await a.sealed()

    return build(folder, story)


@pytest.mark.parametrize(
    ("both", "lasting", "findings"),
    [
        (0, 60, []),
        (4, 60, []),
        (10, 60, [(Kind.OVERLAP, 2)]),
        (10, 50_000, []),
        (30, 50_000, [(Kind.OVERLAP, 2)]),
    ],
)
def test_decisions_of_both_at_once(tmp_path: Path, both: float, lasting: float, findings: list[Any]) -> None:
    made = overlapping(tmp_path, both, lasting=lasting)
    assert found(made) == findings
    assert verified(made.a, made.b).takeovers[1].overlap == ("found" if findings else "excluded")


@pytest.mark.parametrize("who", ["a", "b"])
def test_a_clock_that_was_set_proves_no_overlap(tmp_path: Path, who: str) -> None:
    made = overlapping(tmp_path, 10, clock_set=who)
    assert found(made) == []
    assert verified(made.a, made.b).takeovers[1].overlap == "unknown"


@pytest.mark.parametrize(
    ("seconds", "event", "findings"),
    [
        (6, "", [(Kind.OVERLAP, 1)]),
        (4, "", []),  # a call that was under way
        (6, "clock set forward", []),
        (6, "switchover failed", []),
    ],
)
def test_decisions_after_a_hand_over(tmp_path: Path, seconds: float, event: str, findings: list[Any]) -> None:
    async def story(a: Member, b: Member, _world: World) -> None:
        async with a.active(1):
            await a.decide(2, 2)
        await a.hand_over(1)
        if event:
            a.trail.happened(event, "for a reason")
        await a.decide(2, seconds)
        await a.hand_over(1)
        a.replicate_to(b)
        async with b.active(2):
            await b.decide(2, 2)

    assert found(build(tmp_path, story)) == findings


def test_denials_that_retention_wrote_again_are_old(tmp_path: Path) -> None:
    async def story(a: Member, b: Member, world: World) -> None:
        async with a.active(1):
            await a.decide(5, 5)
        await a.hand_over(1)
        a.log.record(decision(a.log, time=1, detail={"call": "x", "kept": {"sequence": 3}}))
        a.replicate_to(b)
        world.passes(1)
        async with b.active(2):
            await b.sealed()

    assert found(build(tmp_path, story)) == []
