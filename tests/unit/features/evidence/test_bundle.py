import ast
import hashlib
import itertools
import json
import os
import random
import re
import shutil
import struct
import subprocess
import sys
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from appliance.audit.log.retention import Retention
from appliance.audit.proof.copies import read_copies, signed_checkpoints
from appliance.audit.proof.verification import verify
from appliance.audit.search.query import Filter
from appliance.audit.search.search import search
from appliance.base import clock
from appliance.base.clock import wall_ns
from appliance.features.evidence import bundle as bundles
from appliance.features.evidence.bundle import BundleError, TimeSpan, export, verifier_program
from appliance.formats import bundle_verifier
from appliance.signing.log_proof import Checkpoint
from tests.support.audit import decision, settle
from tests.support.control_parts import OPEN
from tests.support.engines import open_log
from tests.support.examples import examples
from tests.support.virtual_clock import VirtualClock
from tests.unit.audit.conftest import MakeLog, Notary
from tests.unit.audit.log.test_retention import make_old, retain
from tests.unit.features.evidence.conftest import LENGTHS, NAMES, NUMBERS, Control

Members = dict[str, bytes]


def members_of(bundle: Path) -> Members:
    with zipfile.ZipFile(bundle) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def written(members: Members, place: Path) -> Path:
    with zipfile.ZipFile(place, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return place


@pytest.fixture
def bundle(control: Control, tmp_path: Path) -> Path:
    return control.exported(tmp_path / "bundle.zip")


@pytest.fixture
def pem(key: Ed25519PrivateKey, tmp_path: Path) -> Path:
    place = tmp_path / "kept.pub"
    place.write_bytes(key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo))
    return place


class Reviewer:
    def __init__(self, capsys: pytest.CaptureFixture[str], key: Path, folder: Path) -> None:
        self._capsys, self._key, self._folder = capsys, key, folder
        self.said = ""

    def status(self, bundle: Path, *options: object) -> int:
        self._capsys.readouterr()
        status = bundle_verifier.main([str(bundle), "--key", str(self._key), *map(str, options)])
        self.said = self._capsys.readouterr().out
        return status

    def refuses(self, members: Members) -> bool:
        return self.status(written(members, self._folder / "x.zip")) == 1


@pytest.fixture
def reviewer(capsys: pytest.CaptureFixture[str], pem: Path, tmp_path: Path) -> Reviewer:
    return Reviewer(capsys, pem, tmp_path)


@pytest.mark.nightly
def test_it_proves_itself_on_a_bare_machine(bundle: Path, pem: Path, tmp_path: Path) -> None:
    folder = tmp_path / "unpacked"
    shutil.unpack_archive(bundle, folder)
    options: list[list[object]] = [[bundle, "--key", pem], [folder, "--key", pem], []]
    for arguments in options:
        command = ["/usr/bin/python3", "-I", *map(str, [folder / "verify.py", *arguments])]
        done = subprocess.run(command, env={}, capture_output=True, text=True, check=False, cwd="/")
        assert (done.returncode, done.stderr) == (0, ""), done.stdout
        assert "valid: the bundle is unchanged since the appliance sealed it" in done.stdout
        assert "unproven" not in done.stdout.replace("unproven  record", "")
    assert "compare it with a copy kept elsewhere" in done.stdout


@pytest.mark.nightly
def test_an_old_python_runs_the_verifier(tmp_path: Path) -> None:
    usual, newer = tmp_path / "usual.py", tmp_path / "newer.py"
    usual.write_text(verifier_program())
    newer.write_text(verifier_program() + "print('a'.removeprefix('a'))\n")
    for program, status in ((usual, 0), (newer, 1)):
        command = [str(Path(sys.executable).with_name("vermin")), "--no-tips", "--target=3.8-", str(program)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == status, done.stdout + done.stderr


@pytest.mark.nightly
def test_it_has_the_events_and_the_rules_in_force(bundle: Path, control: Control) -> None:
    found = members_of(bundle)
    specifications = ["%2E%2E/b%0A.rv", "a.rv", "msg/p/T.msg"]
    assert list(found) == [
        "verify.py", "audit.pub", "policies/7.ini", "signatures/policies/7.ini.sig",
        *(f"specifications/2/{name}" for name in specifications),
        *(f"signatures/specifications/2/{name}.sig" for name in specifications),
        "records.ndjson", "index.html", "manifest.json", "proof.json",
    ]  # fmt: skip
    assert found["policies/7.ini"].decode() == control.policies[7]
    assert found["verify.py"] == verifier_program().encode()
    records = [json.loads(line) for line in found["records.ndjson"].splitlines()]
    decisions = [record for record in records if record["event"] == "decision"]
    assert len(decisions) == 20 + 1, "those of the time, and the one before it"
    assert [record["event"] for record in records[:2]] == ["policy loaded", "specifications loaded"]
    page = found["index.html"].decode()
    assert "\x1b" not in page
    assert "<th>robot<td>arm-3" in page
    assert f"<td>tablet ({decisions[1]['host']})<td>" in page
    [proof] = found["proof.json"].splitlines()
    assert json.loads(json.loads(proof)["detail"])["robot"] == "arm-3"
    assert page.count('<tr class="deny">') == sum(record["decision"] == "deny" for record in decisions[1:])


@pytest.mark.nightly
def test_the_same_time_is_the_same_bundle(control: Control, tmp_path: Path) -> None:
    until = wall_ns() + 1
    control.work(3)
    first, second = (
        members_of(control.exported(tmp_path / name, until=until)) for name in ("a.zip", "b.zip")
    )
    assert first.pop("proof.json") != second.pop("proof.json")
    assert first == second


@pytest.mark.nightly
def test_every_change_of_a_member_is_named(bundle: Path, reviewer: Reviewer) -> None:
    members, chance = members_of(bundle), random.Random(5)  # noqa: S311  the same each time
    for name, data in members.items():
        places = range(len(data)) if len(data) <= 40 else chance.sample(range(len(data)), examples(12))
        for place in places:
            other = bytes([data[place] ^ (1 << chance.randrange(8))])
            changed = data[:place] + other + data[place + 1 :]
            assert reviewer.refuses({**members, name: changed}), (name, place, other)
            named = {"proof.json": r"proof|record \d+|checkpoint \d+", "manifest.json": "manifest|WRONG"}
            assert re.search(named.get(name, re.escape(name)), reviewer.said), (name, place, reviewer.said)


@pytest.mark.nightly
def test_removed_added_or_exchanged_members_are_named(bundle: Path, reviewer: Reviewer) -> None:
    members = members_of(bundle)
    for name, data in members.items():
        without = {other: data for other, data in members.items() if other != name}
        assert reviewer.refuses(without)
        assert f"'{name}': is missing" in reviewer.said or f"{name}: cannot be read" in reviewer.said
        assert reviewer.refuses({**members, name: data[:-1]})
    names = list(members)
    for one, other in itertools.pairwise(names):
        swapped = {**members, one: members[other], other: members[one]}
        if swapped != members:
            assert reviewer.refuses(swapped)
    for name in (
        "more.txt", "../evil", "/etc/evil", "a\\b", "policies/8.ini", "specifications/2/c.rv", "x\x1b[2J",
    ):  # fmt: skip
        assert reviewer.refuses({**members, name: b"x"})
        assert "does not belong to the bundle" in reviewer.said
        assert "\x1b" not in reviewer.said


@pytest.mark.nightly
def test_modules_in_the_folder_are_not_imported(bundle: Path, pem: Path, tmp_path: Path) -> None:
    folder = tmp_path / "unpacked"
    shutil.unpack_archive(bundle, folder)
    (folder / "json.py").write_text(
        "print('valid: the bundle is unchanged since the appliance sealed it'); raise SystemExit(0)"
    )
    command = ["/usr/bin/python3", str(folder / "verify.py"), "--key", str(pem)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
    assert (done.returncode, done.stderr) == (1, ""), done.stdout
    assert "WRONG     'json.py': does not belong to the bundle" in done.stdout


@pytest.mark.nightly
def test_a_bundle_cannot_control_the_terminal(bundle: Path, reviewer: Reviewer) -> None:
    spoilt = "\x1b[2J\nvalid: the bundle is unchanged since the appliance sealed it"

    def change(records: list[dict[str, Any]]) -> None:
        records[0]["sequence"] = spoilt

    assert reviewer.refuses(lines(members_of(bundle), change))
    assert "record \\x1b[2J\\nvalid" in reviewer.said
    assert "\x1b" not in reviewer.said
    assert reviewer.said.splitlines()[-1] == "invalid: the bundle was changed after the export"


def test_a_missing_bundle_is_named(tmp_path: Path, reviewer: Reviewer) -> None:
    assert reviewer.status(tmp_path / "gone.zip") == 2
    assert reviewer.said == f"nothing can be verified: {tmp_path}/gone.zip: No such file or directory\n"


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["manifest.json", "proof.json", "records.ndjson"])
def test_large_members_use_little_memory(bundle: Path, tmp_path: Path, reviewer: Reviewer, name: str) -> None:
    place = tmp_path / "x.zip"
    with zipfile.ZipFile(place, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, data in members_of(bundle).items():
            archive.writestr(member, b"[" * (6 * bundle_verifier.MAX) if member == name else data)
    tracemalloc.start()
    try:
        assert reviewer.status(place) == 1
        assert tracemalloc.get_traced_memory()[1] < 4 * bundle_verifier.MAX
    finally:
        tracemalloc.stop()


@pytest.mark.nightly
def test_a_duplicate_name_is_named(bundle: Path, tmp_path: Path, reviewer: Reviewer) -> None:
    with zipfile.ZipFile(bundle, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("policies/7.ini", members_of(bundle)["policies/7.ini"])
    assert reviewer.status(bundle) == 1
    assert "'policies/7.ini': is present more than once" in reviewer.said


@pytest.mark.nightly
def test_a_cut_or_damaged_file_is_never_valid(bundle: Path, tmp_path: Path, reviewer: Reviewer) -> None:
    whole, members, chance = bundle.read_bytes(), members_of(bundle), random.Random(6)  # noqa: S311  the same each time
    place = tmp_path / "damaged.zip"
    for length in [0, 1, len(whole) - 1, *chance.sample(range(len(whole)), 5)]:
        place.write_bytes(whole[:length])
        assert reviewer.status(place) == 2
    with zipfile.ZipFile(bundle) as archive:
        frame = [*range(archive.start_dir - 24, len(whole))]
        frame += [one.header_offset + byte for one in archive.infolist() for byte in range(50)]
    for position in chance.sample(range(len(whole)), examples(30)) + chance.sample(frame, examples(120)):
        place.write_bytes(whole[:position] + bytes([whole[position] ^ 0x20]) + whole[position + 1 :])
        if not reviewer.status(place):
            assert members_of(place) == members
            assert position not in frame or "another program packed it" in reviewer.said, position
    assert reviewer.status(tmp_path / "missing.zip") == 2


def _longer(path: Path) -> bytes:
    with zipfile.ZipFile(path) as archive:
        last, end, whole = archive.infolist()[-1], archive.start_dir, path.read_bytes()
    whole = whole[:end] + b"evil" + whole[end:]
    for at, number in (
        (last.header_offset + 18, last.compress_size + 4),
        (whole.rindex(b"PK\1\2") + 20, last.compress_size + 4),
        (len(whole) - 6, end + 4),
    ):
        whole = whole[:at] + struct.pack("<L", number) + whole[at + 4 :]
    return whole


@pytest.mark.nightly
def test_data_outside_members_is_named(bundle: Path, tmp_path: Path, reviewer: Reviewer) -> None:
    members, place = members_of(bundle), tmp_path / "x.zip"
    whole = bundle.read_bytes()

    def packed(change: Callable[[zipfile.ZipFile], object] = lambda _archive: None, **about: Any) -> Path:
        with zipfile.ZipFile(place, "w") as archive:
            for name, data in members.items():
                one = zipfile.ZipInfo(name)
                for field, value in about.items():
                    setattr(one, field, value)
                archive.writestr(one, data)
            change(archive)
        return place

    def raw(data: bytes) -> Path:
        place.write_bytes(data)
        return place

    def between(archive: zipfile.ZipFile) -> None:
        archive.writestr("left", b"out")
        archive.filelist.pop()

    def commented(archive: zipfile.ZipFile) -> None:
        archive.comment = b"read me"

    assert reviewer.status(packed()) == 0
    assert "unproven  times and attributes in the ZIP file: another program packed it" in reviewer.said
    assert reviewer.status(packed(compress_type=zipfile.ZIP_DEFLATED)) == 0
    assert reviewer.status(bundle) == 0
    assert "another program" not in reviewer.said
    with zipfile.ZipFile(bundle) as archive:
        first = archive.infolist()[0]
    end = first.header_offset + 30 + len(first.filename) + 20 + first.compress_size
    cases: list[tuple[Callable[[], Path], str]] = [
        (lambda: raw(b"before" + whole), "bytes 0 to 6: belong to no member"),
        (lambda: raw(whole + b"after"), "to the end: are not the end"),
        (lambda: raw(whole[: end + 24] + b"hole" + whole[end + 24 :]), "belong to no member"),
        (lambda: packed(between), "belong to no member"),
        (lambda: packed(commented), "to the end: are not the end"),
        (lambda: packed(comment=b"read me"), "'verify.py': has a comment or an extra field"),
        (lambda: packed(extra=b"\xca\xfe\x04\0evil"), "'verify.py': has an extra field"),
        (lambda: packed(extra=struct.pack("<2HQ", 1, 8, 0xE511)), "'verify.py': has an extra field"),
        (lambda: raw(_longer(packed(compress_type=zipfile.ZIP_DEFLATED))), "'proof.json': extra bytes follow"),
        (lambda: raw(_longer(packed())), "'proof.json': extra bytes follow it"),
    ]  # fmt: skip
    for wrong, words in cases:
        assert reviewer.status(wrong()) == 1, (words, reviewer.said)
        assert words in reviewer.said


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["link", "fifo", "folder"])
def test_a_member_that_is_not_a_file_is_named(
    bundle: Path, tmp_path: Path, reviewer: Reviewer, kind: str
) -> None:
    folder = tmp_path / "unpacked"
    shutil.unpack_archive(bundle, folder)
    policy = folder / "policies/7.ini"
    policy.rename(tmp_path / "7.ini")
    if kind == "link":
        policy.symlink_to(tmp_path / "7.ini")
    elif kind == "folder":
        policy.mkdir()
    else:
        subprocess.run(["mkfifo", policy], check=True)
    assert reviewer.status(folder) == 1
    assert "'policies/7.ini': is missing" in reviewer.said


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["manifest.json", "proof.json", "records.ndjson", "audit.pub"])
def test_a_pipe_does_not_block(bundle: Path, tmp_path: Path, reviewer: Reviewer, name: str) -> None:
    folder = tmp_path / "unpacked"
    shutil.unpack_archive(bundle, folder)
    (folder / name).unlink()
    os.mkfifo(folder / name)
    assert bundle_verifier.main([str(folder)]) == (2 if name == "audit.pub" else 1)
    pipe = folder / name
    assert bundle_verifier.main([str(pipe)]) == 2
    assert bundle_verifier.main([str(bundle), "--key", str(pipe)]) == 2
    assert reviewer.status(bundle, "--checkpoints", pipe) == 2
    assert "is not a regular file" in reviewer.said


@pytest.mark.nightly
def test_an_empty_file_is_not_a_bundle(bundle: Path, tmp_path: Path, reviewer: Reviewer) -> None:
    empty = tmp_path / "empty"
    empty.touch()
    (tmp_path / "folder").mkdir()
    assert (reviewer.status(empty), reviewer.status(tmp_path / "folder")) == (2, 1)
    assert bundle_verifier.main([str(bundle), "--key", str(empty)]) == 2
    assert reviewer.status(bundle, "--checkpoints", empty) == 0


@pytest.mark.nightly
def test_a_zip_bomb_is_not_unpacked(
    bundle: Path, tmp_path: Path, reviewer: Reviewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bundle_verifier, "UNPACKED", 1 << 20)
    place, many = tmp_path / "x.zip", bytes(1 << 25)
    with zipfile.ZipFile(place, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("policies/9.ini", many)
        large = archive.filelist[0]
    with monkeypatch.context() as without, zipfile.ZipFile(tmp_path / "y.zip", "w") as archive:
        without.delattr(zipfile.ZipFile, "open")
        assert reviewer.status(place) == 2
        assert "unpacks to more than" in reviewer.said
        large.file_size, large.compress_size = 100, 10_000
        archive.filelist += [large] * 3
        archive.comment = b"written again"  # a directory whose entries have one position
        archive.close()
        assert reviewer.status(tmp_path / "y.zip") == 2
        assert "overlap" in reviewer.said


@pytest.mark.nightly
@pytest.mark.parametrize("runs", [[[1, 5], [3, 9]], [[5, 9], [1, 3]], [[4, 3]], [[1, 3], [4, 9]]])
def test_runs_are_in_order(bundle: Path, reviewer: Reviewer, runs: list[Any]) -> None:
    """Lookups use binary search, so overlapping, touching or descending runs are rejected."""
    members = members_of(bundle)
    manifest = {**json.loads(members["manifest.json"]), "runs": runs}
    members["manifest.json"] = json.dumps(manifest).encode()
    assert reviewer.refuses(members)
    assert "the runs of manifest.json are not in order" in reviewer.said


def test_many_runs_take_few_steps() -> None:
    asked = 0

    class Counted(int):
        def __lt__(self, other: int) -> bool:
            nonlocal asked
            asked += 1
            return int(self) < other

    runs = bundle_verifier.Runs([[3 * number + 1, 3 * number + 2] for number in range(30_000)])
    runs.last = [Counted(last) for last in runs.last]
    met = [number for number in (0, 1, 2, 3, 4, 90_000) if runs.meet(number, number)]
    assert met == [1, 2, 4]
    assert runs.meet(0, 1)
    assert asked <= 7 * 16
    assert runs.missing == 60_000


def resealed(members: Members) -> Members:
    manifest = json.loads(members["manifest.json"])
    for name, about in manifest["members"].items():
        data = members[name]
        about["sha256"] = hashlib.sha256(data).hexdigest()
    return {**members, "manifest.json": json.dumps(manifest, indent=1).encode() + b"\n"}


def lines(members: Members, change: Callable[[list[dict[str, Any]]], object]) -> Members:
    records = [json.loads(line) for line in members["records.ndjson"].splitlines()]
    change(records)
    text = "".join(json.dumps(record, separators=(",", ":")) + "\n" for record in records)
    return resealed({**members, "records.ndjson": text.encode()})


def _hide(records: list[dict[str, Any]]) -> None:
    denied = (one for one in records if one["decision"] == "deny" and not one["chain"].get("checkpoint"))
    next(denied)["decision"] = "allow"


def _swap(records: list[dict[str, Any]]) -> None:
    records[5], records[6] = records[6], records[5]


def _unseal(records: list[dict[str, Any]]) -> None:
    for record in records:
        record["chain"].pop("checkpoint", None)


def _invent(records: list[dict[str, Any]]) -> None:
    load = next(record for record in records if record["event"] == "policy loaded")
    load["detail"] = json.dumps({**json.loads(load["detail"]), "sha256": "0" * 64})


FORGERIES: dict[str, Callable[[list[dict[str, Any]]], object]] = {
    "hide": _hide, "take out": lambda records: records.pop(6), "swap": _swap,
    "cut": lambda records: records.pop(), "unseal": _unseal, "invent": _invent,
}  # fmt: skip


@pytest.mark.nightly
@pytest.mark.parametrize("forgery", FORGERIES)
def test_a_forger_who_rehashes_has_no_signature(bundle: Path, reviewer: Reviewer, forgery: str) -> None:
    assert reviewer.refuses(lines(members_of(bundle), FORGERIES[forgery]))
    assert "manifest.json: does not match the hash in the log" in reviewer.said
    assert re.search(r"WRONG +(records?[ .]|checkpoint|policies)", reviewer.said), reviewer.said


def _of_another_log(members: Members, *, checkpoints: bool) -> Members:
    manifest = json.loads(members["manifest.json"]) | {"log": "0" * 32}
    changed = {**members, "manifest.json": json.dumps(manifest).encode()}

    def rename(records: list[dict[str, Any]]) -> None:
        for record in records:
            if checkpoints and record["chain"].get("checkpoint"):
                record["chain"]["checkpoint"]["log"] = manifest["log"]

    return lines(changed, rename)


@pytest.mark.nightly
@pytest.mark.parametrize("checkpoints", [False, True], ids=["manifest", "manifest and checkpoints"])
def test_records_of_another_log_are_named(bundle: Path, reviewer: Reviewer, *, checkpoints: bool) -> None:
    """A log that took another one's place proves nothing of the other one."""
    changed = _of_another_log(members_of(bundle), checkpoints=checkpoints)
    assert reviewer.refuses(changed)
    wrong = "is not signed with the key" if checkpoints else "does not seal the records"
    assert re.search(rf"WRONG +checkpoint \d+: {wrong}", reviewer.said), reviewer.said


@pytest.mark.nightly
def test_another_policy_with_a_matching_manifest_is_named(bundle: Path, reviewer: Reviewer) -> None:
    members = {**members_of(bundle), "policies/7.ini": OPEN.encode(), "specifications/2/a.rv": b"none"}
    assert reviewer.refuses(resealed(members))
    for place in ("policies/7.ini", "specifications/2/"):
        assert f"{place}: does not match the hash in the log" in reviewer.said


@pytest.mark.nightly
def test_a_bundle_of_another_key_is_invalid(
    bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = Ed25519PrivateKey.generate().public_key()
    place = tmp_path / "other.pub"
    place.write_bytes(other.public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo))
    unknown = Reviewer(capsys, place, tmp_path)
    assert unknown.status(bundle) == 1
    assert "is not signed with the key" in unknown.said
    assert unknown.said.splitlines()[-1] == f"invalid: {bundle_verifier.UNSIGNED}"
    assert unknown.refuses(lines(members_of(bundle), _hide))
    assert unknown.said.splitlines()[-1] == f"invalid: {bundle_verifier.CHANGED}"


@pytest.mark.nightly
def test_copied_checkpoints_show_a_rewritten_history(
    bundle: Path, control: Control, tmp_path: Path, reviewer: Reviewer
) -> None:
    assert reviewer.status(bundle, "--json") == 0
    said = json.loads(reviewer.said)
    assert (said["ok"], said["findings"], said["kept_elsewhere"]) == (True, [], 0)
    copies = [json.loads(checkpoint.as_json()) for checkpoint in signed_checkpoints(control.log.path)]
    kept = tmp_path / "copies.ndjson"
    kept.write_text("".join(json.dumps(one) + "\n" for one in copies))
    assert reviewer.status(bundle, "--checkpoints", kept) == 0
    match = re.search(r"(\d+) of (\d+) checkpoints were also kept elsewhere", reviewer.said)
    assert match and match[1] == match[2] != "0"
    for copy in copies:
        copy["hash"] = "0" * 64
    kept.write_text("".join(json.dumps(one) + "\n" for one in copies))
    assert reviewer.status(bundle, "--checkpoints", kept) == 1
    assert "differs from the one kept elsewhere, which is not signed with the key" in reviewer.said
    assert re.search(r"^0 of \d+ checkpoints were also kept elsewhere$", reviewer.said, re.MULTILINE)


Copies = list[dict[str, Any]]


def _lines(copies: Copies) -> str:
    return "".join(json.dumps(copy) + "\n" for copy in copies)


def _elsewhere(copies: Copies) -> Copies:
    return [{**copy, "log": "0" * 32, "hash": "cd" * 32} for copy in copies]


KEPT: dict[str, Callable[[Copies, Copies], str]] = {
    "honest": lambda own, _others: _lines(own),
    "forged later": lambda own, others: _lines(others + own),
    "forged earlier": lambda own, others: _lines(own + others),
    "other log first": lambda own, _others: _lines(_elsewhere(own) + own),
    "other log last": lambda own, _others: _lines(own + _elsewhere(own)),
    "other log alone": lambda own, _others: _lines(_elsewhere(own)),
    "torn in the middle": lambda own, _others: _lines(own)[:100] + "\n" + _lines(own),
    "torn at the end": lambda own, _others: _lines(own)[:-50],
    "lines of something else": lambda own, _others: f"[]\n7\n{{}}\n{'[' * 9999}\n" + _lines(own),
}


@pytest.mark.nightly
@pytest.mark.parametrize("kept", KEPT)
def test_kept_checkpoints_have_one_verdict(
    bundle: Path, control: Control, key: Ed25519PrivateKey, tmp_path: Path, reviewer: Reviewer, *, kept: str
) -> None:
    """Root can add checkpoints to the other machine's copies, but not remove those that it got before."""
    own = [json.loads(checkpoint.as_json()) for checkpoint in signed_checkpoints(control.log.path)]
    other = [{**copy, "hash": "ab" * 32} for copy in own]
    for copy in other:
        fields: Any = (copy.get(field) for field in Checkpoint._fields)
        copy["signature"] = key.sign(Checkpoint(*fields).text()).hex()
    place = tmp_path / "copies.ndjson"
    place.write_text(KEPT[kept](own, other))
    found = verify(control.log.path, key.public_key().public_bytes_raw(), copies=read_copies(place)).findings
    assert bool(found) is (kept.startswith("forged") or kept == "other log alone")
    assert reviewer.status(bundle, "--checkpoints", place) == bool(found), reviewer.said
    cause = bundle_verifier.REWRITTEN if kept.startswith("forged") else bundle_verifier.FOREIGN
    unchanged = "valid: the bundle is unchanged since the appliance sealed it"
    assert reviewer.said.splitlines()[-1] == (f"invalid: {cause}" if found else unchanged)
    counted = re.search(r"(\d+) of (\d+) checkpoints? w", reviewer.said)
    assert counted and (counted[1] == counted[2]) is (kept not in {"other log alone", "torn at the end"})


@pytest.mark.nightly
def test_a_recording_is_included(control: Control, tmp_path: Path, reviewer: Reviewer) -> None:
    bag = random.Random(7).randbytes(3 << 20)  # noqa: S311  the same each time
    trigger = {"time": control.begun, "what": "drop", "record": "r", "text": "<b>\x1b"}
    kept = control.record(tmp_path, bag, triggers=[trigger], topics=[{"topic": "/scan"}])
    control.work(2)
    place = control.export(kept, tmp_path / "incident.zip")
    members = members_of(place)
    assert members["recording/recording.bag"] == bag
    assert "&lt;b&gt;\\x1b" in members["index.html"].decode()
    assert "/scan" in members["index.html"].decode()
    assert reviewer.status(place) == 0, reviewer.said
    forged = resealed({**members, "recording/recording.bag": bag[:-1]})
    assert reviewer.refuses(forged)
    assert "recording/recording.bag: does not match the hash in the log" in reviewer.said
    (record,) = search(control.log.path, Filter(event="evidence exported")).entries
    assert record.record.detail["recording"] == kept.id
    (tmp_path / kept.id / "recording.bag").unlink()
    with pytest.raises(BundleError, match=r"recording\.bag: No such file"):
        export(control.log.path, kept, control.ask, NAMES)
    with pytest.raises(BundleError, match="no such"):
        export(control.log.path, kept._replace(id="../audit"), control.ask, NAMES)


@pytest.mark.nightly
def test_unproven_facts_are_listed(control: Control, tmp_path: Path, reviewer: Reviewer) -> None:
    control.load_policy(8, "[Nodes]\n", sha256=None)
    control.work(3)
    control.load_policy(9, "[Nodes]\n# nine\n")
    control.work(3)
    del control.policies[9]
    assert reviewer.status(control.exported(tmp_path / "a.zip")) == 0
    assert "unproven  policies/8.ini: it was loaded by a version that recorded no hash" in reviewer.said
    assert "unproven  policies/9.ini: the appliance does not have it" in reviewer.said
    assert "unproven  record" in reviewer.said


OTHER = "[Nodes]\nof_the_other_state = *\n"


@pytest.mark.nightly
@pytest.mark.parametrize("again", [False, True])
@pytest.mark.parametrize("specifications", ["same", "other", "absent"])
@pytest.mark.parametrize("policy", ["same", "other", "absent"])
def test_an_unaltered_export_is_valid_whatever_the_state_has(  # noqa: PLR0917  one per dimension
    control: Control, tmp_path: Path, reviewer: Reviewer, policy: str, specifications: str, again: bool
) -> None:
    """Revision numbers belong to a state: to that of the other appliance after a join, or to a new one."""
    if again:
        control.load_policy(7, "[Nodes]\n# again seven\n")
        control.load_specifications(2, {"a.rv": "again() { }"})
        control.work(5)
    until = wall_ns() + 1
    control.load_policy(8, OPEN)  # the record after the period
    control.load_specifications(3, {"a.rv": "c() { }"})
    if policy != "same":
        control.policies[7] = OTHER
    if specifications != "same":
        control.specifications[2] = {"a.rv": OTHER}
    if policy == "absent":
        del control.policies[7]
    if specifications == "absent":
        del control.specifications[2]
    bundle = control.exported(tmp_path / "a.zip", until=until)
    assert reviewer.status(bundle) == 0, reviewer.said
    for place, state in (("policies/7.ini", policy), ("specifications/2/", specifications)):
        assert any(name.startswith(place) for name in members_of(bundle)) is (state == "same")
        assert (f"unproven  {place}: the appliance does not have it" in reviewer.said) is (state != "same")


def _as_before(previous: bytes, columns: tuple[object, ...]) -> bytes:
    return hashlib.sha256(previous + msgspec.msgpack.encode(columns)).digest()


@pytest.mark.nightly
def test_a_load_before_the_upgrade_is_listed_as_unproven(
    make_log: MakeLog, tmp_path: Path, reviewer: Reviewer
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("appliance.audit.log.log_writer.record_hash", _as_before)
        before = Control(make_log(checkpoint_seconds=3600))
        before.load_policy(7, OPEN)
        before.work(5)
        before.log.close()
    control = Control(make_log(checkpoint_seconds=3600))
    control.trail.revision, control.policies, control.worked = 7, before.policies, before.worked
    control.work(5)
    bundle = control.exported(tmp_path / "a.zip")
    assert reviewer.status(bundle) == 0, reviewer.said
    assert re.search(r"unproven  records \d+ to \d+: lead to no checkpoint; version 0\.1\.0", reviewer.said)
    assert reviewer.status(control.exported(tmp_path / "b.zip", since=before.begun)) == 0, reviewer.said

    def loosen(records: list[dict[str, Any]]) -> None:
        for record in records:
            record["chain"] = {**record["chain"], "then": None, "checkpoint": None}

    assert reviewer.refuses(lines(members_of(bundle), loosen))
    assert re.search(r"WRONG +records \d+ to \d+: lead to no checkpoint", reviewer.said)


@pytest.mark.nightly
def test_records_removed_by_retention_are_listed(
    make_log: MakeLog, path: Path, notary: Notary, tmp_path: Path, reviewer: Reviewer
) -> None:
    make_old(make_log, notary)
    passing = VirtualClock()
    with clock.using(passing):
        log = make_log(checkpoint_every=100, retention=Retention(days=1))
        log.record(decision(log))
        retain(log)
        log.close()
    running = Control(make_log())
    running.begun = 0
    running.work()
    assert reviewer.status(running.exported(tmp_path / "a.zip")) == 0
    assert "unproven  policies/3.ini: the log has no record of it" in reviewer.said
    assert "unproven  the specifications in force" in reviewer.said
    assert re.search(r"unproven  records before \d+: removed by retention", reviewer.said)


@pytest.mark.nightly
def test_copied_records_are_separate_runs(control: Control, tmp_path: Path, reviewer: Reviewer) -> None:
    until = wall_ns() + 1
    for number in range(1200):
        control.log.record(decision(control.log, number))
    control.log.record(
        decision(control.log, time=until - 1, decision="deny", detail={"kept": {"sequence": 1}})
    )
    control.log.record(decision(control.log))
    settle(control.log)
    bundle = control.exported(tmp_path / "a.zip", until=until)
    runs = json.loads(members_of(bundle)["manifest.json"])["runs"]
    assert [last - first for first, last in runs][1:] == [0]
    assert reviewer.status(bundle) == 0, reviewer.said


@pytest.mark.nightly
def test_empty_and_too_large_time_spans_are_rejected(
    control: Control, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(BundleError, match="no record in that period"):
        export(control.log.path, TimeSpan(0, 1), control.ask, NAMES)
    monkeypatch.setattr(bundles, "MAX_RECORDS", 3)
    with pytest.raises(BundleError, match="more than 3 records"):
        export(control.log.path, TimeSpan(0, wall_ns() + 1), control.ask, NAMES)


def test_an_export_needs_the_signer(path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("appliance.features.evidence.control_part.SEAL_SECONDS", 0.2)
    log = open_log(path, signer=lambda _number, _text, **_: None)
    running = Control(log)
    running.work()
    with pytest.raises(BundleError, match=r"cannot be sealed.*the signer has not answered within 0\.2 s"):
        running.exported(tmp_path / "a.zip")
    log.close()


@pytest.mark.nightly
def test_a_text_changed_during_the_export_ends_it(control: Control) -> None:
    pieces = export(control.log.path, TimeSpan(control.begun, wall_ns() + 1), control.ask, NAMES)
    control.policies[7] = "[Nodes]\n"
    with pytest.raises(BundleError, match=r"policies/7\.ini changed during the export"):
        list(pieces)


def test_columns_are_packed_as_in_the_log() -> None:
    texts = ["é" * length for length in LENGTHS] + ["x" * length for length in (*LENGTHS, 65535, 65536)]
    numbers = [sign * (2**power + step) for power in range(63) for step in (-1, 0, 1) for sign in (-1, 1)]
    values = [None, *texts, *(text.encode() for text in texts), *NUMBERS, *numbers, -(2**63), 2**64 - 1]
    for value in values:
        assert bundle_verifier.pack(value) == msgspec.msgpack.encode(value), repr(value)[:50]
    with pytest.raises(StopIteration):
        bundle_verifier.pack(2**64)
    assert struct.unpack(">b", bundle_verifier.pack(-32)) == (-32,)


def test_the_verifier_runs_on_python_3_8() -> None:
    tree = ast.parse(verifier_program(), feature_version=(3, 8))
    imported = {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    imported |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert imported == {
        "__future__", "argparse", "bisect", "collections", "enum", "hashlib", "json", "os", "pathlib", "re", "stat",
        "struct", "subprocess", "sys", "tempfile", "typing", "zipfile", "zlib",
    }  # fmt: skip
