"""Check the files of the operator and the appliance: policy, specifications, hosts, state directory."""

import os
import stat
from collections.abc import Iterator, Sequence
from pathlib import Path

from cryptography import x509

from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.search.query import Filter
from appliance.audit.search.search import search
from appliance.base import clock
from appliance.base.counted import counted
from appliance.base.input_files import read_given, read_given_text
from appliance.base.shipped import SHIPPED, before_program
from appliance.configuration.settings import Settings
from appliance.features.selftest.selftest_findings import SelftestFinding, fail, ok, run_check, skip, warn
from appliance.features.table import pairing_in
from appliance.hosts.hosts_file import DeclaredHostsError, read_declared
from appliance.policy.cases import run_cases
from appliance.policy.judgement import PolicyContext, judge
from appliance.policy.policy import Policy
from appliance.policy.policy_findings import PolicyError
from appliance.signing.site_keys import read_signature
from appliance.specifications.checking import check
from appliance.specifications.specification_files import SpecificationsRefusedError, read_folder
from appliance.supervisor.clock_sync import clock_is_synchronised
from appliance.supervisor.errors import StartError
from appliance.supervisor.restore_mark import refuse_half_restored
from appliance.supervisor.state_directory import foreign, made_before_0_4

_LITTLE_SPACE, _NO_SPACE = 1 << 30, 50 << 20
_SOON_DAYS = 30
_AHEAD_SECONDS = 60.0


def files(settings: Settings) -> Iterator[SelftestFinding]:
    yield from run_check("policy", lambda: _policy(settings.policy, settings.site_keys))
    yield from run_check("monitors", lambda: _monitors(settings.monitors, settings.site_keys))
    yield from run_check("hosts", lambda: _hosts(settings.hosts))
    yield from run_check("state", lambda: _state(settings.state))


def _policy(file: Path, site_keys: Sequence[str]) -> Iterator[SelftestFinding]:
    try:
        text = read_given_text(file)
        policy = judge(text, str(file), PolicyContext(site_keys=site_keys), read_signature(file)).policy
    except OSError as error:
        if isinstance(error, FileNotFoundError) and file == Settings().policy.absolute():
            first = SHIPPED / "policies" / "default.ini"
            yield warn("policy", f"{file}: does not exist yet", f"to begin with: --policy {first}")
            return
        yield fail(
            "policy",
            f"{file}: {error.strerror}",
            "without a policy the appliance does not start: --policy FILE",
        )
        return
    except UnicodeDecodeError:
        yield fail("policy", f"{file}: not UTF-8", "save the file as UTF-8")
        return
    except PolicyError as error:
        yield fail("policy", str(error.findings[0]), f"rosrv policy check {file}")
        return
    if policy.warnings:
        yield warn(
            "policy", f"{file}: {counted(len(policy.warnings), 'warning')}", f"rosrv policy check {file}"
        )
    else:
        yield ok("policy", f"{file} is valid")
    yield from _cases(file, policy)


def _cases(file: Path, policy: Policy) -> Iterator[SelftestFinding]:
    beside = file.with_name(file.name + ".tests.yaml")
    try:
        results = run_cases(policy, read_given_text(beside), str(beside))
    except FileNotFoundError:
        return
    except (OSError, UnicodeDecodeError, PolicyError) as error:
        yield fail("policy tests", str(error), "a policy whose tests cannot be read is not reloaded")
        return
    failed = [result for result in results if not result.passed]
    if failed:
        yield fail("policy tests", str(failed[0]), f"rosrv policy test {file}")
    else:
        yield ok("policy tests", f"{len(results)} passed")


def _monitors(folder: Path | None, site_keys: Sequence[str]) -> Iterator[SelftestFinding]:
    if folder is None:
        yield skip("monitors", "no folder of specifications is configured")
        return
    try:
        checked = check(read_folder(folder), site_keys)
    except SpecificationsRefusedError as error:
        yield fail("monitors", error.findings[0], f"rosrv monitor check {folder}/*.rv")
        return
    text = f"{len(checked.monitors)} in {folder}"
    if checked.warnings:
        yield warn(
            "monitors",
            f"{text}, {counted(len(checked.warnings), 'warning')}",
            f"rosrv monitor check {folder}/*.rv",
        )
    else:
        yield ok("monitors", text)


def _hosts(file: Path) -> Iterator[SelftestFinding]:
    try:
        declared = read_declared(file)
    except DeclaredHostsError as error:
        yield fail("hosts", str(error), "correct the file; until then it declares no hosts")
        return
    yield ok("hosts", f"{len(declared)} declared in {file}" if declared else "no hosts are declared")


def _state(state: Path) -> Iterator[SelftestFinding]:
    if not state.exists():
        parent = next(folder for folder in state.absolute().parents if folder.exists())
        if os.access(parent, os.W_OK):
            yield ok("state", f"{state} will be created")
        else:
            yield fail(
                "state", f"{state} cannot be created in {parent}", "run as root, or use another: --state DIR"
            )
        return
    mode = state.stat().st_mode
    if not stat.S_ISDIR(mode):
        yield fail("state", f"{state} is not a directory", "use another: --state DIR")
        return
    try:
        reason = foreign(state) or made_before_0_4(state) if os.access(state, os.R_OK) else None
    except OSError as error:
        yield skip("state", f"what is stored is not read: {error}", "run as the appliance's owner, or root")
        reason = None
    if reason:
        yield fail("state", reason, "use another, empty or new: --state DIR")
        return
    if mode & 0o022:
        yield fail("state", f"{state}: other users may write (mode {mode & 0o777:o})", f"chmod 711 {state}")
    elif not os.access(state, os.W_OK):
        yield warn("state", f"{state}: this user may not write", "run as the appliance's owner, or root")
    else:
        yield ok("state", f"{state}, mode {mode & 0o777:o}")
    yield from run_check("restore", lambda: unfinished_restore(state))
    yield from run_check("pair", lambda: membership(state))
    yield from run_check("secrets", lambda: _secrets(state))
    yield from run_check("space", lambda: _space(state))
    yield from run_check("clock", lambda: _clock(state))
    yield from run_check("certificates", lambda: certificates(state))


def unfinished_restore(state: Path) -> Iterator[SelftestFinding]:
    try:
        refuse_half_restored(state)
    except StartError as error:
        yield fail("restore", str(error), "rosrv restore")


def membership(state: Path) -> Iterator[SelftestFinding]:
    """One of two appliances does not start with a membership that it cannot read."""
    try:
        pairing = pairing_in(state)
    except StartError as error:
        yield fail("pair", str(error), "rosrv standby join, or rosrv standby leave")
    else:
        if pairing is not None:
            yield ok("pair", f"one of two; the other one is {pairing.other}")


def _secrets(state: Path) -> Iterator[SelftestFinding]:
    open_to_others = []
    for path in (
        *state.glob("signer/*.key"),
        state / "api" / "key.pem",
        state / "first-token",
        *state.glob("control/*.db"),
    ):
        try:
            mode = path.stat().st_mode
        except OSError:
            continue
        if mode & 0o007:
            open_to_others.append(f"{path} ({mode & 0o777:o})")
    if open_to_others:
        yield fail("secrets", f"other users may read {', '.join(open_to_others)}", "chmod o= these files")
    if (state / "first-token").exists():
        advice = f"store it in a safe place, then: rm {state / 'first-token'}"
        yield warn("first token", f"{state / 'first-token'} still exists", advice)


def _space(state: Path) -> Iterator[SelftestFinding]:
    room = os.statvfs(state)
    free = room.f_bavail * room.f_frsize
    shown = f"{free / (1 << 30):.1f} GiB free"
    if free < _NO_SPACE:
        yield fail(
            "space", shown, "free disk space: requests are denied while the audit log cannot be written"
        )
    elif free < _LITTLE_SPACE:
        yield warn(
            "space", shown, "free disk space, or limit the log: audit.retention_bytes in appliance.yaml"
        )
    else:
        yield ok("space", shown)


def _clock(state: Path) -> Iterator[SelftestFinding]:
    before = before_program()
    if before:
        yield fail("clock", f"{before / 86_400:.0f} days before this program was built", "set the clock")
        return
    log = state / "control" / "audit.db"
    if not os.access(log, os.R_OK):
        return
    try:
        entries = search(log, Filter(), limit=1).entries
    except LogUnreadableError as error:
        yield fail("audit log", str(error), "rosrv audit verify")
        return
    ahead = entries[0].record.time / 1e9 - clock.wall() if entries else 0.0
    if ahead > _AHEAD_SECONDS:
        yield fail(
            "clock", f"the last record of the audit log is {ahead:.0f} s in the future", "set the clock"
        )
    elif clock_is_synchronised() is False:
        yield warn("clock", "no time service synchronises it", "run chrony or systemd-timesyncd")
    else:
        yield ok("clock", clock.utc_now().strftime("%Y-%m-%d %H:%MZ"))


def certificates(state: Path) -> Iterator[SelftestFinding]:
    rotate = f"rosrv host authority rotate --state {state}, then new kits for all hosts"
    advice = {
        state / "api" / "certificate.pem": "remove it and restart: a new one is created",
        state / "signer" / "ca.pem": f"restore it from a backup, or stop the appliance: {rotate}",
    }
    for path, remedy in advice.items():
        try:
            certificate = x509.load_pem_x509_certificate(read_given(path))
        except (FileNotFoundError, PermissionError):
            continue
        except ValueError:
            yield fail("certificate", f"{path} is not a certificate", remedy)
            continue
        left = certificate.not_valid_after_utc - clock.utc_now()
        if left.days < 0:
            yield fail("certificate", f"{path} has expired", remedy)
        elif left.days < _SOON_DAYS:
            yield warn("certificate", f"{path} expires in {left.days} days", remedy)
        else:
            yield ok("certificate", f"{path.name} of {path.parent.name}: {left.days} days left")
