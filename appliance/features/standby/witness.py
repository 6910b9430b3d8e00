#!/usr/bin/env python3
"""Hold the lease of two appliances on the robot's own computer, and enforce it in the robot's firewall.

    witness.py shut   [--settings FILE]                              at boot: shut out both appliances
    witness.py serve  [--settings FILE]                              answer the appliances
    witness.py follow [--settings FILE]                              on another computer: do as the witness does
    witness.py begin  [--settings FILE] --in-sync a,b --epoch N      write the lease again, after damage
    witness.py remove [--settings FILE]                              remove the firewall rules

This file runs alone, with the standard library of Python 3.5 to 3.12 and the program `nft` or `iptables`.

1. A claim is granted only after the lease has expired, to an appliance in the in-sync set. A grant increments the
   epoch, saves it, and changes the firewall before it is answered. If one of these fails, nothing is granted.
2. Only the holder changes the in-sync set. Each change is on the disk before it is answered.
3. Every start waits one expiry before the first grant. After a reboot both appliances are shut out; a renewal of
   the holder admits it again, since no other appliance has had a grant.
4. A damaged or missing lease shuts out both appliances, until an operator runs `begin`.
5. A full disk prevents no change: the file of the lease keeps its size. Each answer says why the next takeover would
   fail: a disk that cannot be written, or a program that cannot list the rules or fails a trial of those of the next
   takeover. Neither stops a renewal of the holder.
6. After a change that may be on the disk or not, each appliance counts as in sync for the holder, and the lease is
   saved again before the next change.

The firewall translates one fixed address to the holder, and rejects all other traffic of the other appliance with TCP
resets. For an idle connection, the witness sends its local socket a segment outside its window; the firewall rejects
the acknowledgement with a reset. A socket that still waits for the answer to its first packet repeats that packet
only after 1, 3 and 7 seconds; the witness sends it such a packet, whose answer is rejected likewise. Tunnels, ping,
resets and requests to the witness pass. The rules are for IPv4: give the appliances no IPv6 address that the robot
reaches.
"""

import argparse
import contextlib
import fcntl
import functools
import hashlib
import hmac
import ipaddress
import json
import os
import platform
import re
import select
import shutil
import signal
import socket
import stat
import struct
import subprocess
import sys
import threading
import time
import traceback
from typing import Any, Callable, Dict, Iterable, Iterator, List, NamedTuple, Optional, Set, Tuple

EXPIRY = 1.2  # seconds after a renewal until another appliance may have the lease
LONGEST = 1024  # bytes of a datagram
HIGHEST = 1 << 53  # of numbers and epochs, which JSON carries exactly
REQUEST, ANSWER = b"rosrv lease request 1\0", b"rosrv lease answer 1\0"
OPERATIONS = ("renew", "claim", "remove", "add", "release", "look")
TABLE = "rosrv_witness"
_CHAINS = "rosrv-witness"
_JUMPS = (
    ("filter", (("INPUT", "in"), ("OUTPUT", "out"), ("FORWARD", "forward"))),
    ("nat", (("OUTPUT", "nat"), ("PREROUTING", "nat"))),
    ("raw", (("OUTPUT", "raw"),)),
)
MARK = 0x72777431  # of the witness's own segments, which the connection tracker must not see
SETTINGS = "/etc/rosrv/witness.json"
BOOT_ID = "/proc/sys/kernel/random/boot_id"
_MAC = hashlib.sha256().digest_size
_TAG = 4  # bytes
_NAME = re.compile(r"[a-z][a-z0-9-]{0,31}\Z")
_TUNNEL_PORTS = (500, 4500)
_FREEBIND, _SO_MARK = (
    15,
    36,
)  # socket options that Python 3.5 does not name; FREEBIND: the network may be down
_PROGRAM_SECONDS = 20.0  # at a boot, the first rule loads kernel modules from a slow disk
_CHECK_SECONDS, _TRIAL_SECONDS = 1.0, 10.0  # between two listings; between two trials of the next rules
_POLL_SECONDS = 0.05  # between two checks whether a running program is still wanted
_NETFILTER, _CT_DELETE, _NLM_REQUEST = 12, 0x102, 1
_RESET_SECONDS, _RESET_ROUNDS = 0.6, 8  # a kernel answers one segment outside the window each half second
_BATCH = 64  # datagrams of unknown sources between two checks of the time, and of the sockets of known ones
_EACH = 8  # datagrams of each known source in this time, so that a flood of one delays no renewal of another
_LOOK_SECONDS = 0.2  # between two requests of a follower
_MOST_PENDING = 8
_CONFIDENCE = 0.9  # of the time that an answer has left
_CLOCK_BOOTTIME = 7  # runs while the computer sleeps; Python 3.5 does not name it
_MOST_FOLLOWERS = 32
_LINES, _LINES_SECONDS = 20, 10.0
_FLAPS, _FLAP_SECONDS, _MOST_FLAPS = (
    3,
    60.0,
    100,
)  # interruptions in this time that are reported; that are counted
_REPORT = 160  # characters
_NOT_REPORTED = re.compile(r"[^ !#-\[\]-~]")  # an escaped character would need more bytes of a datagram
_COPY = 4096  # bytes of each of the two copies of the lease: a block of the disk
_DISK_SECONDS, _SLOW_SECONDS = 30.0, 5.0  # between two checks of the disk; that a write may take
# States in /proc/net/tcp: the peer may still send; it has not answered yet.
_ESTABLISHED, _CONNECTING = ("01", "03", "04", "05", "06", "08"), ("02",)
_ACK, _SYN = 0x10, 0x02
_MAPPED = "0000000000000000FFFF0000"  # an IPv4 address in /proc/net/tcp6

Left = Callable[[], float]
Program = Callable[[List[str], str, Left], str]
Ends = Tuple[str, int, str, int]  # of a connection: the own address and port, those of the peer


class WitnessError(Exception):
    """A request, a setting or the system that prevents an operation; the message has the remedy."""


class UncertainError(WitnessError):
    """The change may have been made, or a part of it."""


class PostponedError(WitnessError):
    """A check was ended for something more urgent, so its earlier result stays."""


Answered = NamedTuple("Answered", [("epoch", int), ("holder", str), ("until", float)])
"""The newest answer to a follower: it may admit `holder` (or no appliance, "") until a time of its clock."""

LeaseRecord = NamedTuple(
    "LeaseRecord", [("epoch", int), ("holder", str), ("in_sync", Tuple[str, ...]), ("boot", str)]
)
"""The lease on the disk. `holder` is empty before the first grant; `boot` identifies the boot of its last change."""

AppliancePeer = NamedTuple("AppliancePeer", [("address", str), ("key", bytes)])

WitnessSettings = NamedTuple(
    "WitnessSettings",
    [
        ("listen", Tuple[str, int]),
        ("fixed", str),
        ("ports", Tuple[str, ...]),
        ("appliances", Dict[str, AppliancePeer]),
        ("state", str),
        ("followers", Dict[str, AppliancePeer]),
        ("follows_as", str),
    ],
)
"""`fixed` is the address that the robot's nodes use; `ports` are translated to the holder.

`followers` are the other computers that ask the witness. In the settings of a follower, `follows_as` is its name,
`followers` has only itself, and the appliances have no keys.
"""


# ---- Datagrams


@functools.lru_cache(maxsize=64)
def tag_of(key: bytes) -> bytes:
    """Return the first bytes of all datagrams with this key, so most forged datagrams cost no authentication."""
    return hmac.new(key, b"rosrv lease tag 1\0", hashlib.sha256).digest()[:_TAG]


def seal(purpose: bytes, name: str, key: bytes, body: Dict[str, Any]) -> bytes:
    """Return a datagram: tag, name, authentication code, and the body as JSON."""
    label = name.encode("ascii")
    text = json.dumps(body, sort_keys=True, separators=(",", ":")).encode("ascii")
    head = tag_of(key) + bytes([len(label)]) + label
    return head + hmac.new(key, purpose + head + text, hashlib.sha256).digest() + text


def name_in(datagram: bytes) -> str:
    """Return the name in a datagram, which is not authenticated yet, or an empty string."""
    if not _TAG + 1 + _MAC < len(datagram) <= LONGEST:
        return ""
    name = datagram[_TAG + 1 : _TAG + 1 + datagram[_TAG]].decode("ascii", "replace")
    return name if _NAME.match(name) else ""


def unseal(purpose: bytes, key: bytes, datagram: bytes) -> Optional[Dict[str, Any]]:
    if datagram[:_TAG] != tag_of(key):
        return None
    end = _TAG + 1 + datagram[_TAG]
    code, text = datagram[end : end + _MAC], datagram[end + _MAC :]
    expected = hmac.new(key, purpose + datagram[:end] + text, hashlib.sha256).digest()
    if not hmac.compare_digest(code, expected):
        return None
    try:
        body = json.loads(text.decode("ascii"))
    except ValueError:
        return None
    return body if isinstance(body, dict) else None


def is_count(value: object) -> bool:
    return type(value) is int and 0 <= value <= HIGHEST


# ---- The lease


class LeaseFile:
    """The lease on the disk: two copies in a file that keeps its size, so that no change needs free space.

    A crash leaves at most one copy incomplete, and the other one is right: the change was not answered before
    both were written. The file of an earlier version has one copy.

    """

    def __init__(self, path: str, names: Tuple[str, ...]) -> None:
        self.path = path
        self._names = names
        self._lock = -1

    def __enter__(self) -> "LeaseFile":
        os.makedirs(os.path.dirname(os.path.abspath(self.path)), mode=0o700, exist_ok=True)
        self._lock = os.open(self.path + ".lock", os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self.__exit__()
            raise WitnessError(
                "another witness uses %s; stop it first: systemctl stop rosrv-witness" % self.path
            ) from error
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._lock)
        self._lock = -1

    def read(self) -> LeaseRecord:
        try:
            with open(self.path, "rb") as file:
                content = file.read(2 * _COPY + 1)
            if len(content) != 2 * _COPY:
                return self._record(content)
            try:
                return self._record(content[:_COPY])
            except (ValueError, KeyError, TypeError):
                return self._record(content[_COPY:])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise WitnessError(
                "the lease %s cannot be used: %s; both appliances are shut out. Run: witness.py begin --in-sync NAMES"
                " --epoch N, with the appliances that have all data and an epoch greater than both appliances show"
                % (self.path, error)
            ) from error

    def _record(self, copy: bytes) -> LeaseRecord:
        code, _, text = copy.rstrip(b" ").partition(b"\n")
        if code.decode("ascii") != hashlib.sha256(text).hexdigest():
            raise ValueError("its checksum is wrong")
        body = json.loads(text.decode("ascii"))
        record = LeaseRecord(body["epoch"], body["holder"], tuple(body["in_sync"]), body["boot"])
        if not (is_count(record.epoch) and record.in_sync and set(record.in_sync) <= set(self._names)):
            raise ValueError("it does not fit the settings")
        if record.holder and record.holder not in record.in_sync:
            raise ValueError("its holder is not in sync")
        return record

    def check_disk(self) -> None:
        write_synced(self.path + ".check", b" " * _COPY)

    def has_room(self) -> bool:
        try:
            return os.stat(self.path).st_size == 2 * _COPY
        except OSError:
            return False

    def write(self, record: LeaseRecord) -> None:
        """Save the lease. After a `WitnessError` that is not an `UncertainError`, the old lease stays."""
        body = {
            "epoch": record.epoch,
            "holder": record.holder,
            "in_sync": list(record.in_sync),
            "boot": record.boot,
        }
        text = json.dumps(body, sort_keys=True).encode("ascii")
        copy = (hashlib.sha256(text).hexdigest().encode("ascii") + b"\n" + text).ljust(_COPY)
        failure = WitnessError
        try:
            if self.has_room():
                for offset in (0, _COPY):
                    with synced(self.path, os.O_WRONLY) as descriptor:
                        written = os.pwrite(descriptor, copy, offset)
                        failure = UncertainError
                        if written != _COPY:
                            raise OSError("a part was written")
                return
            new = self.path + ".new"
            with contextlib.suppress(FileNotFoundError):
                os.unlink(new)
            write_synced(new, 2 * copy)
            os.rename(new, self.path)
            failure = UncertainError
            with synced(os.path.dirname(os.path.abspath(new)), os.O_RDONLY):
                pass
        except OSError as error:
            raise failure("the lease %s cannot be saved: %s" % (self.path, error)) from error


@contextlib.contextmanager
def synced(path: str, flags: int) -> Iterator[int]:
    """Open a file or folder, and wait at the end until its changes are on the disk."""
    descriptor = os.open(path, flags, 0o600)
    try:
        yield descriptor
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_synced(path: str, content: bytes) -> None:
    with synced(path, os.O_WRONLY | os.O_CREAT) as descriptor:
        if os.write(descriptor, content) != len(content):
            raise OSError("the disk is full")


class RegularCheck:
    """Checks something regularly in a thread, so that neither a slow disk nor a slow program delays an answer.

    `check` raises `OSError` or `WitnessError`; then `failure` is the beginning of the reported text.
    """

    def __init__(self, failure: str, check: Callable[[], Any], clock: Callable[[], float]) -> None:
        self._text = failure
        self._check = check
        self._clock = clock
        self._began = None  # type: Optional[float]
        self._failure = ""

    def start(self, seconds: float) -> None:
        threading.Thread(target=self._run_always, args=(seconds,), daemon=True).start()

    def _run_always(self, seconds: float) -> None:
        while True:
            self.run()
            select.select([], [], [], _CHECK_SECONDS if self._failure else seconds)

    def run(self) -> None:
        self._began = self._clock()
        try:
            self._check()
            self._failure = ""
        except PostponedError:
            pass
        except (OSError, WitnessError) as error:
            self._failure = "%s: %s" % (self._text, error)
        self._began = None

    def trouble(self) -> str:
        began = self._began
        if began is not None and self._clock() - began > _SLOW_SECONDS:
            return "%s: that takes more than %d s" % (self._text, _SLOW_SECONDS)
        return self._failure


class Witness:
    """The rules of the lease.

    `admit` changes the firewall to admit one appliance, or none (""). It raises `UncertainError` if it may have
    changed something, and `WitnessError` if not; so does `save`. Without a `record`, every request is refused.

    """

    def __init__(
        self,
        *,
        record: Optional[LeaseRecord],
        save: Callable[[LeaseRecord], None],
        admit: Callable[[str], None],
        boot: str,
        clock: Callable[[], float],
    ) -> None:
        self.record = record
        self._save = save
        self._admit = admit
        self._boot = boot
        self._clock = clock
        self._expires = clock() + EXPIRY
        self.trouble = ""  # why the next takeover would fail
        self.unknown_rules = (
            ""  # why the rules cannot be listed, or those of the next takeover not be written
        )
        self.unsettled = False  # whether the disk may have another lease than `record`
        # Within one boot the rules of an earlier process stay, so that its end alone changes nothing.
        self.admitted = record.holder if record is not None and record.boot == boot else ""
        admit(self.admitted)

    def enforce_again(self) -> None:
        holder = self.record.holder if self.record is not None else ""
        self._enforce(holder if self.admitted == holder else "")

    def settle(self) -> None:
        """Save the lease again, so that the disk has this one."""
        if self.record is not None:
            self._save(self.record)
        self.unsettled = False

    def now(self) -> float:
        return self._clock()

    def left(self) -> float:
        return max(0.0, self._expires - self._clock())

    def handle(self, name: str, operation: str, epoch: int, other: str) -> str:
        if self.record is None:
            return "the lease is damaged: run witness.py begin on the robot"
        if epoch > self.record.epoch:
            return (
                "the witness knows only epoch %d: run witness.py begin with a greater epoch"
                % self.record.epoch
            )
        try:
            if operation in ("claim", "look"):
                return self._claim(self.record, name) if operation == "claim" else ""
            if (self.record.holder, self.record.epoch) != (name, epoch):
                return "%s holds epoch %d" % (self.record.holder or "no appliance", self.record.epoch)
            if operation == "renew":
                self._renew(self.record)
            elif operation == "release":
                self._expires = self._clock()
            else:
                self._change_in_sync(self.record, {name, other} if operation == "add" else {name})
        except WitnessError as error:
            return str(error)
        return ""

    def _claim(self, before: LeaseRecord, name: str) -> str:
        if self._clock() < self._expires:
            return "%s holds the lease for another %.1f s" % (before.holder or "no appliance", self.left())
        if name not in before.in_sync:
            return "%s is not in sync" % name
        if self.unknown_rules:
            return self.unknown_rules
        self._change(before._replace(epoch=before.epoch + 1, holder=name, boot=self._boot))
        try:
            self._enforce(name)
        except WitnessError:
            self._change(before)
            raise
        self._expires = self._clock() + EXPIRY
        return ""

    def _renew(self, record: LeaseRecord) -> None:
        if self.admitted != record.holder:
            self._change(record._replace(boot=self._boot))
            self._enforce(record.holder)
        self._expires = self._clock() + EXPIRY

    def _change_in_sync(self, record: LeaseRecord, wanted: Set[str]) -> None:
        if wanted != set(record.in_sync):
            self._change(record._replace(in_sync=tuple(sorted(wanted))))

    def _change(self, record: LeaseRecord) -> None:
        if self.unsettled:
            self.settle()
        try:
            self._save(record)
        except UncertainError:
            self.unsettled = True
            raise
        self.record = record

    def _enforce(self, name: str) -> None:
        before = self.admitted
        try:
            self._admit(name)
        except UncertainError:
            self.admitted = "?"  # after a second failure, the next renewal tries again
            self._admit(before if before != "?" else "")
            self.admitted = before
            raise
        self.admitted = name


class WitnessGate:
    """Checks datagrams: each request is authenticated, and newer than all earlier ones of its appliance.

    A request has the witness's nonce of this start, which no earlier recording can have, and a rising number. An
    old nonce or number is answered with the present ones. A follower's request may have a `report` of its troubles,
    which the answers to the appliances repeat.

    """

    def __init__(
        self,
        witness: Witness,
        appliances: Dict[str, AppliancePeer],
        nonce: str,
        followers: Optional[Dict[str, AppliancePeer]] = None,
    ) -> None:
        self._witness = witness
        self._appliances = appliances
        self._peers = dict(followers or {})
        self._peers.update(appliances)
        self._nonce = nonce
        self._last = dict.fromkeys(self._peers, 0)
        self._reports = {}  # type: Dict[str, Tuple[float, str]]
        self.rejected = 0
        self.fresh = ""  # the name in the last datagram, if it was authentic and new

    def answer(self, datagram: bytes, address: str) -> Optional[bytes]:
        name, self.fresh = name_in(datagram), ""
        peer = self._peers.get(name)
        body = None
        if peer is not None and peer.address == address:
            body = unseal(REQUEST, peer.key, datagram)
        if peer is None or body is None or not (self._well_formed(body) and self._allowed(name, body)):
            self.rejected += 1
            return None
        return seal(ANSWER, name, peer.key, self._answer(name, body))

    def _allowed(self, name: str, body: Dict[str, Any]) -> bool:
        """Return whether this peer may request the operation. A follower cannot change the lease."""
        return name in self._appliances or body["do"] == "look"

    def _well_formed(self, body: Dict[str, Any]) -> bool:
        return (
            set(body) - {"report"} == {"boot", "session", "number", "do", "epoch"}
            and isinstance(body.get("report", ""), str)
            and all(isinstance(body[field], str) and len(body[field]) <= 32 for field in ("boot", "session"))
            and is_count(body["number"])
            and is_count(body["epoch"])
            and body["do"] in OPERATIONS
        )

    def _answer(self, name: str, body: Dict[str, Any]) -> Dict[str, Any]:
        answer = {"boot": self._nonce, "session": body["session"], "number": body["number"]}  # type: Dict[str, Any]
        if body["boot"] != self._nonce or body["number"] <= self._last[name]:
            answer.update(stale=True, last=self._last[name])
            return answer
        self._last[name] = body["number"]
        self.fresh = name
        other = next(iter(set(self._appliances) - {name}))  # not used for `look`, the operation of followers
        reason = self._witness.handle(name, body["do"], body["epoch"], other)
        record = self._witness.record
        answer.update(
            ok=not reason,
            reason=reason[:200].encode("ascii", "replace").decode("ascii"),
            epoch=record.epoch if record is not None else 0,
            holder=record.holder if record is not None else "",
            in_sync=[]
            if record is None
            else sorted(self._appliances if self._witness.unsettled else record.in_sync),
            expired=not self._witness.left(),
            trouble=self._witness.trouble[:200].encode("ascii", "replace").decode("ascii"),
        )
        if name in self._appliances:
            answer.update(followers=self._reported())
            return answer
        self._reports[name] = self._witness.now(), _NOT_REPORTED.sub("?", body.get("report", ""))[:_REPORT]
        admitted = self._witness.admitted
        answer.update(
            admitted=admitted if admitted in self._appliances else "",
            left=int(self._witness.left() * 1000),
            reports=True,
        )
        return answer

    def _reported(self) -> str:
        """Return the troubles of the followers. The last one of a follower that is silent now is repeated for a
        minute.
        """
        since = self._witness.now() - _FLAP_SECONDS
        found = [
            "%s: %s" % (name, text)
            for name, (at, text) in sorted(self._reports.items())
            if text and at > since
        ]
        return "; ".join(found)[:_REPORT]


class WitnessFollower:
    """The rules of a follower.

    It admits an appliance only for 0.9 of the time that its lease has left, counted from the time the request was
    *sent*; the rest allows for clocks of different speeds. So while the robot admits one appliance, no follower
    begins to admit the other, unless the first has given the lease up: rules that are still being written when this
    time ends are abandoned. Without answers, both are shut out after at most one expiry.

    A slow disk or firewall delays no answer: `request` and `receive` belong to the thread that asks, `save_epoch` to
    one that saves, all others to the one that writes the rules. Each field is assigned by one of them.
    """

    def __init__(
        self,
        *,
        name: str,
        key: bytes,
        appliances: Iterable[str],
        session: str,
        epoch: int,  # the greatest saved; no smaller one, of a witness restored from an old disk, is accepted
        save: Callable[[int], None],
        admit: Callable[[str, Left], None],  # raises `UncertainError` if the time that is left ends
        clock: Callable[[], float],  # runs even while the computer sleeps
    ) -> None:
        self.epoch = epoch
        self.refusal = ""
        self.answered = clock()
        self.report = ""  # for the witness
        self._name = name
        self._key = key
        self._appliances = frozenset(appliances)
        self._session = session
        self._save = save
        self._admit = admit
        self._clock = clock
        self._boot = ""
        self._number = 0
        self._reporting = False
        self._pending = {}  # type: Dict[int, float]
        self._newest = self._used = Answered(0, "", 0.0)
        self._saved = epoch
        self._admitted = "?"  # unknown: an earlier process may have written rules
        self._opened = False
        self._interrupted = []  # type: List[float]
        self.tick()

    def request(self) -> bytes:
        self._number += 1
        self._pending[self._number] = self._clock()
        if len(self._pending) > _MOST_PENDING:
            del self._pending[min(self._pending)]
        body = {
            "boot": self._boot,
            "session": self._session,
            "number": self._number,
            "do": "look",
            "epoch": self.epoch,
        }
        if self._reporting:  # an earlier version of the witness rejects the field
            body["report"] = self.report
        return seal(REQUEST, self._name, self._key, body)

    def receive(self, datagram: bytes) -> None:
        body = unseal(ANSWER, self._key, datagram) if name_in(datagram) == self._name else None
        if body is None or body.get("session") != self._session or not is_count(body.get("number")):
            return
        sent = self._pending.get(body["number"])
        if sent is None:
            return
        self.answered = self._clock()
        # An answer that overtook earlier ones is newer: theirs no longer count.
        self._pending = {number: at for number, at in self._pending.items() if number > body["number"]}
        if body.get("stale") is True:
            if isinstance(body.get("boot"), str) and is_count(body.get("last")):
                self._boot, self._number = body["boot"], max(self._number, body["last"])
            return
        epoch, left, admitted = body.get("epoch"), body.get("left"), body.get("admitted")  # type: Any, Any, Any
        if not (is_count(epoch) and is_count(left) and isinstance(admitted, str)):
            return
        self._reporting = body.get("reports") is True
        self.refusal = ""
        if body.get("ok") is not True:
            self.refusal = str(body.get("reason"))[:200]
        elif epoch < self.epoch:
            self.refusal = "the witness has epoch %d, but had %d before" % (epoch, self.epoch)
        if self.refusal or (admitted and admitted not in self._appliances):
            return
        self.epoch = epoch
        self._newest = Answered(epoch, admitted, sent + _CONFIDENCE * min(left / 1000.0, EXPIRY))

    def save_epoch(self) -> bool:
        """Save a new epoch, and return whether there was one. Until then no answer with it admits an appliance."""
        epoch = self._newest.epoch
        if epoch <= self._saved:
            return False
        self._save(epoch)
        self._saved = epoch
        return True

    def tick(self) -> None:
        wanted = self._wanted()
        if wanted == self._admitted:
            return
        try:
            self.enforce(wanted)
        except UncertainError:
            if self._wanted() == wanted:
                raise
            self.enforce("")  # the lease ended, so the writing was abandoned

    def enforce_again(self) -> None:
        self.enforce(self._wanted())

    def enforce(self, name: str) -> None:
        """Write the rules; after a `WitnessError`, the next `tick` tries again."""
        if self._opened and not name:
            self._interrupted = [*self._interrupted[1 - _MOST_FLAPS :], self._clock()]
        self._admitted, self._opened = "?", bool(name)
        self._admit(name, lambda: self._left(name))
        self._admitted = name

    def pause(self) -> float:
        """Return the seconds until the next `tick` is due, if no answer comes."""
        now, wanted = self._clock(), self._wanted()
        if self._admitted not in (wanted, "?"):
            return 0.0
        return min(_LOOK_SECONDS, self._used.until - now) if wanted else _LOOK_SECONDS

    def note(self, trouble: str) -> None:
        """Report a trouble of this computer, or that topics are interrupted again and again."""
        now = self._clock()
        interrupted = sum(now - at < _FLAP_SECONDS for at in self._interrupted)
        if not trouble and interrupted >= _FLAPS:
            trouble = "it shut out both appliances %d times in a minute" % interrupted
        self.report = trouble[:_REPORT]

    def _wanted(self) -> str:
        newest = self._newest
        if newest.epoch <= self._saved:
            self._used = newest
        return self._used.holder if self._clock() < self._used.until else ""

    def _left(self, name: str) -> float:
        """Return the seconds that rules may still need until they are in force."""
        if not name:
            return EXPIRY  # to shut out is always right
        return self._used.until - self._clock() if self._wanted() == name else 0.0


# ---- The firewall


def nft_rules(settings: WitnessSettings, admitted: str) -> str:
    """Return the rules that admit one appliance. They also drop requests without the tag of the sender's key."""
    names = sorted(settings.appliances)
    control = "{ %s }" % ", ".join(map(str, (*_TUNNEL_PORTS, settings.listen[1])))
    local = 'iif "lo" ip daddr %s udp dport %d drop' % settings.listen  # no appliance is on this computer
    translate, arriving, leaving = [], [local, 'iif "lo" accept'], []  # type: List[str], List[str], List[str]
    for name in names:
        address = settings.appliances[name].address
        if name == admitted:
            ports = ", ".join(settings.ports)
            translate.append("ip daddr %s tcp dport { %s } dnat to %s" % (settings.fixed, ports, address))
            continue
        for rules, side, port in ((arriving, "saddr", "dport"), (leaving, "daddr", "sport")):
            match = "ip %s %s" % (side, address)
            rules += [
                "%s udp %s %s accept" % (match, port, control),
                "%s udp %s %s accept" % (match, "dport" if port == "sport" else "sport", control),
                "%s ip protocol { icmp, esp } accept" % match,
                "%s tcp flags & rst == rst accept" % match,
                "%s ip protocol tcp reject with tcp reset" % match,
                "%s drop" % match,
            ]
    followers = [settings.followers[name].address for name in sorted(settings.followers)]
    addresses = ", ".join([settings.appliances[name].address for name in names] + followers)
    requests = ["udp dport %d ip saddr != { %s } drop" % (settings.listen[1], addresses)]
    requests += [
        "ip saddr %s udp dport %d @th,64,32 != 0x%s drop"
        % (peer.address, settings.listen[1], tag_of(peer.key).hex())
        for _name, peer in sorted({**settings.appliances, **settings.followers}.items())
        if peer.key  # a follower has no keys of the appliances
    ]
    leaving += [
        "ip daddr %s ip protocol tcp reject with tcp reset" % settings.fixed,
        "ip daddr %s drop" % settings.fixed,
    ]
    chains = (
        ("untracked", "filter hook output priority -300", ["meta mark %d notrack" % MARK]),
        ("translate_own", "nat hook output priority -100", translate),
        ("translate_others", "nat hook prerouting priority -100", translate),
        ("arriving", "filter hook input priority 0", arriving + requests),
        ("leaving", "filter hook output priority 0", leaving),
        ("forwarded", "filter hook forward priority 0", arriving[2:] + leaving),
    )
    return "table ip %s\ndelete table ip %s\ntable ip %s {\n%s}\n" % (
        TABLE,
        TABLE,
        TABLE,
        "".join(
            "    chain %s {\n        type %s; policy accept;\n%s    }\n"
            % (name, hook, "".join("        %s\n" % rule for rule in rules))
            for name, hook, rules in chains
        ),
    )


def iptables_rules(settings: WitnessSettings, admitted: str, present: Dict[str, List[str]]) -> str:
    """Return the input of iptables-restore that admits one appliance.

    The filter comes first: until the translation follows, connections to the fixed address are rejected or go to the
    new holder. Our jump becomes the first rule, before any that accepts established connections.
    """
    names = sorted(settings.appliances)
    control = ",".join(map(str, (*_TUNNEL_PORTS, settings.listen[1])))
    translate, coming, going = [], [], []  # type: List[str], List[str], List[str]
    reset = "-p tcp -j REJECT --reject-with tcp-reset"
    for name in names:
        address = settings.appliances[name].address
        if name == admitted:
            translate += [
                "-d %s -p tcp --dport %s -j DNAT --to-destination %s"
                % (settings.fixed, ports.replace("-", ":"), address)
                for ports in settings.ports
            ]
            continue
        for rules, side in ((coming, "-s"), (going, "-d")):
            rules += ["%s %s %s" % (side, address, rule) for rule in _passing(control)]
            rules += ["%s %s %s" % (side, address, reset), "%s %s -j DROP" % (side, address)]
    going += ["-d %s %s" % (settings.fixed, reset), "-d %s -j DROP" % settings.fixed]
    peers = [settings.appliances[name].address for name in names]
    peers += [settings.followers[name].address for name in sorted(settings.followers)]
    requests = ["-s %s -j RETURN" % one for one in peers]
    requests.append("-p udp --dport %d -j DROP" % settings.listen[1])
    chains = {
        "in": [
            "-i lo -d %s -p udp --dport %d -j DROP" % settings.listen,
            "-i lo -j RETURN",
            *coming,
            *requests,
        ],
        "out": going,
        "forward": coming + going,
        "nat": translate,
        "raw": ["-m mark --mark %d -j CT --notrack" % MARK],
    }
    lines = []  # type: List[str]
    for table, jumps in _JUMPS:
        own = sorted({name for _, name in jumps})
        lines.append("*" + table)
        lines += [":%s-%s - [0:0]" % (_CHAINS, name) for name in own]
        lines += ["-A %s-%s %s" % (_CHAINS, name, rule) for name in own for rule in chains[name]]
        for chain, name in jumps:
            jump = "%s -j %s-%s" % (chain, _CHAINS, name)
            rules = present.get("%s %s" % (table, chain), [])
            if rules[:1] != ["-A " + jump]:
                lines += ["-D " + jump] * rules.count("-A " + jump)
                lines.append("-I " + jump)
        lines.append("COMMIT")
    return "\n".join(lines) + "\n"


def _passing(control: str) -> List[str]:
    ports = ["-p udp -m multiport --%ss %s -j RETURN" % (side, control) for side in ("dport", "sport")]
    return [*ports, "-p icmp -j RETURN", "-p esp -j RETURN", "-p tcp --tcp-flags RST RST -j RETURN"]


def without_iptables_rules(saved: str) -> str:
    lines, own = [], []  # type: List[str], List[str]
    for line in saved.splitlines():
        if line.startswith("*"):
            lines.append(line)
        elif line.startswith(":%s-" % _CHAINS):
            own.append(line[1:].split()[0])
        elif (
            line.startswith("-A ")
            and line.split()[-1].startswith(_CHAINS + "-")
            and line.split()[1] not in own
        ):
            lines.append(line.replace("-A", "-D", 1))
        elif line == "COMMIT":
            lines += ["-F " + chain for chain in own] + ["-X " + chain for chain in own] + [line]
            own = []
    return "\n".join(lines) + "\n"


def always() -> float:
    return _PROGRAM_SECONDS


def run_program(command: List[str], text: str, left: Left = always) -> str:
    """Run a program of the firewall; `left` returns the seconds for which it is still wanted."""
    streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}  # type: Dict[str, Any]
    began = time.monotonic()
    try:
        process = subprocess.Popen(command, start_new_session=True, **streams)
    except OSError as error:
        raise WitnessError("%s: %s" % (command[0], error)) from error
    with contextlib.ExitStack() as ended:
        for stream in (process.stdin, process.stdout, process.stderr):
            ended.callback(_close, stream)
        given = text.encode("utf-8")  # type: Optional[bytes]
        while True:
            try:
                done = process.communicate(given, timeout=max(0.0, min(_POLL_SECONDS, left())))
                break
            except subprocess.TimeoutExpired:
                given = None  # it has the input already
            seconds = time.monotonic() - began
            if left() <= 0 or seconds > _PROGRAM_SECONDS:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)  # also what a script has started
                process.wait()
                raise UncertainError("%s: ended after %.1f s" % (command[0], seconds))
    said, failed = (one.decode("utf-8", "replace") for one in done)  # type: str, str
    if process.returncode:
        failure = WitnessError if process.returncode > 0 else UncertainError  # it was killed
        raise failure("%s: %s" % (command[0], " ".join(failed.split())[:150] or process.returncode))
    return said


def _close(stream: Any) -> None:
    with contextlib.suppress(OSError):  # input that the program did not read
        stream.close()


def chosen_backend(release: str, find: Callable[[str], Optional[str]]) -> str:
    """Return nft or iptables. Before Linux 4.18, translations of nft and iptables exclude one another."""
    version = tuple(int(number) for number in re.findall(r"[0-9]{1,9}", release)[:2])
    if find("nft") and version >= (4, 18):
        return "nft"
    if find("iptables-restore"):
        return "iptables"
    raise WitnessError("neither `nft` nor `iptables` is installed: sudo apt install nftables")


def remove_rules(backend: str, run: Program = run_program) -> None:
    if backend == "nft":
        run(["nft", "-f", "-"], "table ip %s\ndelete table ip %s\n" % (TABLE, TABLE), always)
    else:
        present = run(["iptables-save"], "", always)
        run(["iptables-restore", "--noflush"], without_iptables_rules(present), always)


class LeaseFirewall:
    """The robot's firewall, by `nft` or `iptables`."""

    def __init__(self, settings: WitnessSettings, backend: str, run: Program = run_program) -> None:
        self._settings = settings
        self._backend = backend
        self._run = run
        self._written = None  # type: Optional[List[str]]
        self._rules = 0
        self._restoring = threading.Lock()
        self.waiting = False

    def admit(self, name: str, left: Left = always) -> None:
        """Raise `UncertainError` if the time that is left ends before the rules are in force."""
        before, self._written = self._written, None
        self.waiting = True  # a trial ends, because only one program may have the lock of iptables
        with self._restoring:
            self.waiting = False
            try:
                self._write(name, left)
            except UncertainError:
                raise
            except WitnessError:
                self._written = before
                raise
        with contextlib.suppress(WitnessError):  # unread rules are not intact: they are written again
            self._written = self.present(left)

    def _write(self, name: str, left: Left) -> None:
        if self._backend == "nft":
            self._run(["nft", "-f", "-"], nft_rules(self._settings, name), left)  # changes all rules, or none
            return
        text = iptables_rules(self._settings, name, self._chains(left))
        try:
            self._run(["iptables-restore", "--noflush"], text, left)
        except WitnessError as error:
            raise UncertainError(str(error)) from error  # each table is changed separately
        self._rules = text.count("-A %s-" % _CHAINS)

    def try_out(self, name: str) -> None:
        """Let the kernel check the rules that admit an appliance, without a change. A change is not delayed."""
        with self._restoring:
            try:
                if self._backend == "nft":
                    self._run(["nft", "-c", "-f", "-"], nft_rules(self._settings, name), self._unhindered)
                else:
                    text = iptables_rules(self._settings, name, self._chains(self._unhindered))
                    self._run(["iptables-restore", "--test", "--noflush"], text, self._unhindered)
            except UncertainError as error:
                if self.waiting:
                    raise PostponedError(str(error)) from error
                raise

    def _unhindered(self) -> float:
        return 0.0 if self.waiting else _PROGRAM_SECONDS

    @property
    def read(self) -> bool:
        """Whether the rules were read after they were written."""
        return self._written is not None

    def intact(self, present: List[str]) -> bool:
        """Return whether the rules are still those that were written.

        Another program may have changed them before they were first read. So the jumps, which must be first, and the
        number of rules are compared with the written text.
        """
        jumps = ["-A %s -j %s-%s" % (chain, _CHAINS, name) for _, rows in _JUMPS for chain, name in rows]
        whole = present[: len(jumps)] == jumps and len(present) == len(jumps) + self._rules
        return present == self._written and (whole or self._backend == "nft")

    def _chains(self, left: Left = always) -> Dict[str, List[str]]:
        found, table = {}, ""  # type: Dict[str, List[str]], str
        for line in self._run(["iptables-save"], "", left).splitlines():
            table = line[1:] if line.startswith("*") else table
            if line.startswith("-A "):
                found.setdefault("%s %s" % (table, line.split()[1]), []).append(line)
        return found

    def present(self, left: Left = always) -> List[str]:
        if self._backend == "nft":
            try:
                return [self._run(["nft", "list", "table", "ip", TABLE], "", left)]
            except UncertainError:
                raise
            except WitnessError:
                if "table ip " + TABLE in self._run(["nft", "list", "tables"], "", left).splitlines():
                    raise
                return [""]  # the table is gone
        chains = self._chains(left)
        jumps = [chains.get("%s %s" % (table, chain), [""])[0] for table, rows in _JUMPS for chain, _ in rows]
        return jumps + [rule for name in sorted(chains) if _CHAINS in name for rule in chains[name]]


# ---- Idle connections


def sockets_with(
    addresses: Set[str], tables: List[str], states: Tuple[str, ...] = _ESTABLISHED
) -> List[Ends]:
    found = []
    for line in [line for table in tables for line in table.splitlines()[1:]]:
        fields = line.split()
        if fields[3] in states:
            (own, own_port), (peer, peer_port) = (_end(fields[1]), _end(fields[2]))
            if peer in addresses:
                found.append((own, own_port, peer, peer_port))
    return found


def _end(text: str) -> Tuple[str, int]:
    address, _, port = text.partition(":")
    if address.startswith(_MAPPED):
        address = address[len(_MAPPED) :]
    if len(address) != 8:
        return "", 0
    return socket.inet_ntoa(struct.pack("=I", int(address, 16))), int(port, 16)


def segment(connection: Ends, flags: int, number: int) -> bytes:
    own, own_port, peer, peer_port = connection
    ends = socket.inet_aton(peer) + socket.inet_aton(own)
    tcp = struct.pack("!HHIIBBHHH", peer_port, own_port, number, number, 5 << 4, flags, 0, 0, 0)
    words = struct.unpack("!16H", ends + struct.pack("!BBH", 0, socket.IPPROTO_TCP, len(tcp)) + tcp)
    total = sum(words)
    total = (total & 0xFFFF) + (total >> 16)
    checksum = ~(total + (total >> 16)) & 0xFFFF
    header = struct.pack("!BBHHHBBH", 0x45, 0, 20 + len(tcp), 0, 0, 64, socket.IPPROTO_TCP, 0)
    return header + ends + tcp[:16] + struct.pack("!H", checksum) + tcp[18:]


def forgetting(connection: Ends) -> bytes:
    """Return the message that deletes a connection from the kernel's connection tracker (ctnetlink)."""
    own, own_port, peer, peer_port = connection
    addresses = _attribute(1, socket.inet_aton(own)) + _attribute(2, socket.inet_aton(peer))
    ports = _attribute(2, struct.pack("!H", own_port)) + _attribute(3, struct.pack("!H", peer_port))
    ends = _nested(1, addresses) + _nested(2, _attribute(1, struct.pack("!B", socket.IPPROTO_TCP)) + ports)
    body = struct.pack("!BBH", socket.AF_INET, 0, 0) + _nested(1, ends)
    return struct.pack("=IHHII", 16 + len(body), _CT_DELETE, _NLM_REQUEST, 0, 0) + body


def forget(connections: List[Ends]) -> None:
    """Delete connections from the connection tracker, if this kernel has its interface."""
    kernel = (socket.AF_NETLINK, socket.SOCK_RAW, _NETFILTER)
    with contextlib.suppress(OSError), socket.socket(*kernel) as tracker:
        for connection in connections:
            tracker.send(forgetting(connection))


def _attribute(kind: int, value: bytes) -> bytes:
    return struct.pack("=HH", 4 + len(value), kind) + value + b"\0" * (-len(value) % 4)


def _nested(kind: int, attributes: bytes) -> bytes:
    return _attribute(kind | 0x8000, attributes)


class IdleConnections:
    """Resets local connections with an appliance that is no longer admitted, even idle ones.

    For ten seconds after a reset, the connection tracker would lead a new connection from the same port to the earlier
    appliance, so reset connections are deleted from it.
    """

    def __init__(self, settings: WitnessSettings) -> None:
        self._settings = settings
        self._raw = socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_RAW)
        self._raw.setsockopt(socket.SOL_SOCKET, _SO_MARK, MARK)
        self._raw.setblocking(False)
        self._left = []  # type: List[Ends]
        self._rounds = 0

    def connecting(self) -> List[Ends]:
        return sockets_with(self._addresses(""), _socket_tables(), _CONNECTING)

    def reset(self, admitted: str, connecting: Iterable[Ends] = ()) -> None:
        """Begin to reset the connections.

        `connecting` wait for a first answer since before the rules changed, so the connection tracker leads their
        first packet to the earlier appliance for good.
        """
        addresses = self._addresses(admitted)
        self._left = sockets_with(addresses, _socket_tables())
        self._left += [ends for ends in connecting if ends[2] in addresses]
        self._rounds = _RESET_ROUNDS
        self.go_on()

    def go_on(self) -> bool:
        if not self._left:
            return False
        peers, tables = {peer for _, _, peer, _ in self._left}, _socket_tables()
        present = dict.fromkeys(sockets_with(peers, tables), _ACK)
        present.update((ends, _SYN) for ends in sockets_with(peers, tables, _CONNECTING))
        forget([ends for ends in self._left if ends not in present])
        self._left = [ends for ends in self._left if ends in present]
        self._rounds -= 1
        for ends in self._left:
            number = struct.unpack("!I", os.urandom(4))[0]
            try:
                self._raw.sendto(segment(ends, present[ends], number), (ends[0], 0))
            except OSError:
                continue  # the next round sends it again
        if self._rounds <= 0:
            self._left = []
        return bool(self._left)

    def _addresses(self, admitted: str) -> Set[str]:
        appliances = self._settings.appliances.items()
        return {peer.address for name, peer in appliances if name != admitted} | {self._settings.fixed}


def _socket_tables() -> List[str]:
    tables = []
    for path in ("/proc/net/tcp", "/proc/net/tcp6"):
        if os.path.exists(path):
            with open(path, encoding="ascii") as file:
                tables.append(file.read())
    return tables


# ---- The program


def read_settings(path: str) -> WitnessSettings:
    """Raise `WitnessError` if other users can read the file, since it has the keys."""
    try:
        with open(path, encoding="utf-8") as file:
            if stat.S_IMODE(os.fstat(file.fileno()).st_mode) & 0o077:
                raise ValueError("other users can read its keys: chmod 600 %s" % path)
            return settings_of(json.loads(file.read(65536)))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = "%s is missing" % error if isinstance(error, KeyError) else str(error)
        raise WitnessError("the settings %s cannot be used: %s" % (path, reason)) from error


def settings_of(body: Dict[str, Any]) -> WitnessSettings:
    host, _, port = body["listen"].rpartition(":")
    follows_as = body.get("follows_as", "")
    appliances = _peers(body["appliances"], keys=not follows_as)
    followers = _peers(body.get("followers", {}), keys=True)
    fixed = {_address(body["fixed"]), _address(host)}
    addresses = fixed.union(one.address for table in (appliances, followers) for one in table.values())
    keys = [one.key for table in (appliances, followers) for one in table.values() if one.key]
    if len(appliances) != 2 or len(set(keys)) != len(keys) or set(appliances) & set(followers):
        raise ValueError(
            "it needs two appliances, and a name and a key of its own for each and each follower"
        )
    if len(addresses) != 4 + len(followers):
        raise ValueError("it needs different addresses: the witness, fixed, two appliances, each follower")
    if len(followers) > _MOST_FOLLOWERS:
        raise ValueError("it has more than %d followers" % _MOST_FOLLOWERS)
    if follows_as and list(followers) != [follows_as]:
        raise ValueError("follows_as must be the only follower in it")
    ports = tuple(_ports(text) for text in body["ports"])
    if not ports:
        raise ValueError("ports is empty; list those of the ROS master and the relay, such as 11311")
    return WitnessSettings(
        (_address(host), int(_ports(port))),
        _address(body["fixed"]),
        ports,
        appliances,
        str(body["state"]),
        followers,
        follows_as,
    )


def _peers(table: Dict[str, Dict[str, str]], keys: bool) -> Dict[str, AppliancePeer]:
    found = {}
    for name, one in table.items():
        if not _NAME.match(name):
            raise ValueError("the name %r is not valid; use a-z, 0-9 and -" % name)
        if keys and not re.match(r"[0-9a-f]{64}\Z", one["key"]):
            raise ValueError("the key of %s does not have 64 hexadecimal digits" % name)
        found[name] = AppliancePeer(_address(one["address"]), bytes.fromhex(one["key"]) if keys else b"")
    return found


def _address(text: str) -> str:
    address = ipaddress.IPv4Address(text)
    if address.is_multicast or address.is_unspecified or address.is_loopback:
        raise ValueError("%s cannot be an address of the robot's network" % text)
    return str(address)


def _ports(text: str) -> str:
    first, _, last = text.partition("-")
    if not (first.isdigit() and (last or first).isdigit() and 0 < int(first) <= int(last or first) < 65536):
        raise ValueError("%r is not a port or a range such as 20000-20999" % text)
    return text


class BoundedLog:
    """Lines on standard error; if there are more than a few in some seconds, only their number is printed."""

    def __init__(self, write: Callable[[str], Any], clock: Callable[[], float]) -> None:
        self._write = write
        self._clock = clock
        self._since = clock()
        self._lines = 0
        self._one = threading.Lock()

    def add(self, text: str) -> None:
        with self._one:
            self._add(text)

    def _add(self, text: str) -> None:
        now = self._clock()
        if now - self._since > _LINES_SECONDS:
            if self._lines > _LINES:
                self._write("%d more lines were left out\n" % (self._lines - _LINES))
            self._since, self._lines = now, 0
        self._lines += 1
        if self._lines <= _LINES:
            self._write(text + "\n")


def _write_error(text: str) -> None:
    sys.stderr.write(text)
    sys.stderr.flush()  # before Python 3.9 a pipe gets the text only when the buffer is full


class LeaseEnforcement:
    """The firewall and the idle connections of this computer. One thread uses all but the checks."""

    def __init__(
        self,
        firewall: LeaseFirewall,
        idle: IdleConnections,
        appliances: Iterable[str],
        log: BoundedLog,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.firewall = firewall
        self._idle = idle
        self._log = log
        self._names = sorted(appliances)
        self._clock = clock
        self._admitted = ""
        self._checked = self._reset = clock()
        self._changes = 0  # odd while rules are written
        self._listed = None  # type: Optional[Tuple[int, List[str]]]
        self.listing = RegularCheck("the firewall rules cannot be listed", self._list, clock)
        text = "the firewall rules of a takeover cannot be written"
        self.trial = RegularCheck(text, self._try_next, clock)

    def start_checks(self) -> None:
        self.listing.start(_CHECK_SECONDS)
        self.trial.start(_TRIAL_SECONDS)

    def trouble(self) -> str:
        return self.listing.trouble() or self.trial.trouble()

    def _list(self) -> None:
        changes = self._changes
        present = self.firewall.present()
        if changes % 2 == 0:
            self._listed = changes, present

    def _try_next(self) -> None:
        self.firewall.try_out(next(name for name in self._names if name != self._admitted))

    def admit(self, name: str, left: Left = always) -> None:
        self._changes += 1
        try:
            connecting = self._idle.connecting()
            self.firewall.admit(name, left)
        finally:
            self._changes += 1
        self._admitted = name
        self._idle.reset(name, connecting)
        self._log.add("the robot admits %s" % (name or "no appliance"))

    def go_on(self, enforce_again: Callable[[], None]) -> bool:
        now = self._clock()
        if now - self._reset >= _RESET_SECONDS:
            self._reset = now
            self._idle.go_on()
        listed, self._listed = self._listed, None
        try:
            if listed is not None and listed[0] == self._changes and not self.firewall.intact(listed[1]):
                cause = "another program changed the firewall rules of the witness"
                if not self.firewall.read:
                    cause = "the firewall rules of the witness could not be read after they were written"
                self._log.add(cause + "; they are written again")
                enforce_again()
        except WitnessError as error:
            self._log.add(str(error))
        if now - self._checked < _CHECK_SECONDS:
            return False
        self._checked = now
        return True


def enforcement_of(settings: WitnessSettings, backend: str, log: BoundedLog) -> LeaseEnforcement:
    firewall, idle = LeaseFirewall(settings, backend), IdleConnections(settings)
    return LeaseEnforcement(firewall, idle, settings.appliances, log)


def _shut(settings: WitnessSettings, backend: str) -> None:
    """Shut out both appliances. At a boot there is no connection to reset."""
    LeaseFirewall(settings, backend).admit("")
    idle = IdleConnections(settings)
    idle.reset("")
    while idle.go_on():
        select.select([], [], [], _RESET_SECONDS)


def serve(settings: WitnessSettings, backend: str, lease: LeaseFile) -> None:
    log = BoundedLog(_write_error, time.monotonic)
    enforcement = enforcement_of(settings, backend, log)
    try:
        record = lease.read()  # type: Optional[LeaseRecord]
    except WitnessError as error:
        record = None
        log.add(str(error))
    with open(BOOT_ID, encoding="ascii") as file:
        boot = file.read().strip()
    witness = Witness(
        record=record, save=lease.write, admit=enforcement.admit, boot=boot, clock=time.monotonic
    )
    gate = WitnessGate(witness, settings.appliances, os.urandom(16).hex(), settings.followers)
    disk = RegularCheck(
        "the disk of the lease %s cannot be written" % lease.path, lease.check_disk, time.monotonic
    )
    disk.start(_DISK_SECONDS)
    enforcement.start_checks()
    with RequestSockets(settings.listen) as requests:
        log.add("the witness answers at %s:%d and uses %s" % (*settings.listen, backend))
        rejected = 0
        while True:  # until the process is ended; each turn is bounded
            for one, most in requests.ready():
                for _ in range(most):
                    if not _answer_one(one, gate, requests):
                        break
            if not enforcement.go_on(witness.enforce_again):
                continue
            witness.unknown_rules = enforcement.trouble()
            _note_trouble(witness, lease, disk, log)
            if gate.rejected > rejected:
                log.add("%d requests without a valid authentication code" % (gate.rejected - rejected))
                rejected = gate.rejected


def _note_trouble(witness: Witness, lease: LeaseFile, disk: RegularCheck, log: BoundedLog) -> None:
    """Put into answers why the next takeover would fail. If the file lacks space, try to get it."""
    trouble = ""
    if witness.record is not None:
        trouble = witness.unknown_rules or disk.trouble()
        if not disk.trouble() and (witness.unsettled or not lease.has_room()):
            try:
                witness.settle()
            except WitnessError as error:
                trouble = str(error)
    if trouble != witness.trouble:
        log.add(trouble or "nothing prevents a takeover now")
    witness.trouble = trouble


class RequestSockets:
    """The sockets for requests: one for all hosts, and one for each appliance and follower since its last new
    request.

    The kernel gives datagrams from the address *and port* of that request to the connected socket. Another host
    cannot guess this port, so datagrams with a forged address fill only the buffer of the common socket.
    """

    def __init__(self, listen: Tuple[str, int]) -> None:
        self._listen = listen
        self._common = self._bound()
        self._connected = {}  # type: Dict[str, Tuple[socket.socket, Tuple[str, int]]]

    def __enter__(self) -> "RequestSockets":
        return self

    def __exit__(self, *_: object) -> None:
        for one in [self._common] + [one for one, _ in self._connected.values()]:
            one.close()

    def ready(self) -> List[Tuple[socket.socket, int]]:
        connected = [one for one, _ in self._connected.values()]
        found, _, _ = select.select([*connected, self._common], [], [], 0.2)
        return [(one, _BATCH if one is self._common else _EACH) for one in found]

    def prefer(self, name: str, source: Tuple[str, int]) -> None:
        """Connect a socket to the source of a new request. If that raises `OSError`, the common socket serves it."""
        before = self._connected.get(name)
        if before is not None and before[1] == source:
            return
        one = self._bound()
        try:
            one.connect(source)
        except OSError:
            one.close()
            raise
        self._connected[name] = (one, source)
        if before is not None:
            before[0].close()

    def _bound(self) -> socket.socket:
        one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            one.setsockopt(socket.SOL_IP, _FREEBIND, 1)
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)  # only for sockets of the same user
            one.bind(self._listen)
        except OSError:
            one.close()
            raise
        one.setblocking(False)
        return one


def _answer_one(one: socket.socket, gate: WitnessGate, requests: RequestSockets) -> bool:
    try:
        datagram, source = one.recvfrom(LONGEST + 1)
    except BlockingIOError:
        return False
    except OSError:
        return True  # an earlier answer was not delivered
    answer = gate.answer(datagram, source[0])
    with contextlib.suppress(OSError):  # no route to the appliance at present; it asks again
        if answer is not None:
            one.sendto(answer, source)
        if gate.fresh:
            requests.prefer(gate.fresh, source)
    return True


def follow(settings: WitnessSettings, backend: str, lease: LeaseFile) -> None:
    log = BoundedLog(_write_error, time.monotonic)
    enforcement = enforcement_of(settings, backend, log)
    names = tuple(sorted(settings.appliances))
    own = settings.followers[settings.follows_as]
    follower = WitnessFollower(
        name=settings.follows_as,
        key=own.key,
        appliances=names,
        session=os.urandom(16).hex(),
        epoch=followed_epoch(lease, log),
        save=lambda epoch: lease.write(LeaseRecord(epoch, "", names, "")),
        admit=enforcement.admit,
        clock=_boot_seconds,
    )
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        asking.setsockopt(socket.SOL_IP, _FREEBIND, 1)
        asking.bind((own.address, 0))
        asking.setblocking(False)
        log.add(
            "%s follows the witness at %s:%d and uses %s" % (settings.follows_as, *settings.listen, backend)
        )
        enforcement.start_checks()
        writing, saving = Wake(), Wake()
        _start(lambda: _ask_always(asking, settings.listen, follower, (writing, saving)))
        _start(lambda: _save_always(follower, (writing, saving), log))
        shown = ""
        while True:  # until the process is ended; each turn is bounded
            writing.wait(follower.pause())
            try:
                follower.tick()
            except WitnessError as error:
                log.add(str(error))
            follower.note(enforcement.trouble())
            silent = _boot_seconds() - follower.answered > EXPIRY
            state = "the witness at %s:%d does not answer" % settings.listen if silent else follower.refusal
            state = state or follower.report
            if state != shown:
                shown = state
                log.add(state or "the witness answers, and the rules can be written")
            enforcement.go_on(follower.enforce_again)


class Wake:
    """Wakes a waiting thread. Unlike those of `threading`, a wait is not prolonged by a change of the wall clock,
    which Python before 3.11 uses for them.
    """

    def __init__(self) -> None:
        self._reader, self._writer = socket.socketpair()
        self._reader.setblocking(False)
        self._writer.setblocking(False)

    def set(self) -> None:
        with contextlib.suppress(BlockingIOError):  # it has enough to wake for
            self._writer.send(b".")

    def wait(self, seconds: float) -> None:
        ready, _, _ = select.select([self._reader], [], [], max(0.0, seconds))
        if ready:
            self._reader.recv(_COPY)


def _start(run: Callable[[], None]) -> None:
    """Run a thread, without which the process must end."""

    def run_or_end() -> None:
        try:
            run()
        except Exception:  # noqa: BLE001  whatever it is: systemd starts the program again
            traceback.print_exc()
        os._exit(1)

    threading.Thread(target=run_or_end, daemon=True).start()


def _ask_always(
    asking: socket.socket, witness: Tuple[str, int], follower: WitnessFollower, wakes: Iterable[Wake]
) -> None:
    asked = time.monotonic() - _LOOK_SECONDS
    while True:
        left = asked + _LOOK_SECONDS - time.monotonic()
        ready, _, _ = select.select([asking], [], [], max(0.0, left))
        for _ in range(_BATCH if ready else 0):
            if not _receive_one(asking, witness, follower):
                break
        for wake in wakes if ready else ():
            wake.set()
        if time.monotonic() - asked >= _LOOK_SECONDS:
            asked = time.monotonic()
            _send_look(asking, witness, follower)


def _save_always(follower: WitnessFollower, wakes: Tuple[Wake, Wake], log: BoundedLog) -> None:
    writing, saving = wakes
    while True:
        saving.wait(_CHECK_SECONDS)
        try:
            if follower.save_epoch():
                writing.set()
        except WitnessError as error:
            log.add(str(error))


def _boot_seconds() -> float:
    return time.clock_gettime(_CLOCK_BOOTTIME)


def followed_epoch(lease: LeaseFile, log: BoundedLog) -> int:
    """Return the greatest epoch that this follower saved. If the file is damaged, no answer is new enough."""
    if not os.path.exists(lease.path):
        return 0
    try:
        return lease.read().epoch
    except WitnessError as error:
        log.add(
            "the epoch %s cannot be used: %s; both appliances are shut out. If the lease of the witness was not"
            " restored from an older disk: rm %s; systemctl restart rosrv-witness-follow"
            % (lease.path, error.__cause__, lease.path)
        )
        return HIGHEST


def _send_look(asking: socket.socket, witness: Tuple[str, int], follower: WitnessFollower) -> None:
    with contextlib.suppress(OSError):  # no route to the witness at present; it is asked again
        asking.sendto(follower.request(), witness)


def _receive_one(asking: socket.socket, witness: Tuple[str, int], follower: WitnessFollower) -> bool:
    try:
        datagram, source = asking.recvfrom(LONGEST + 1)
    except BlockingIOError:
        return False
    except OSError:
        return True  # an earlier request was not delivered
    if source == witness:
        follower.receive(datagram)
    return True


def begin(settings: WitnessSettings, lease: LeaseFile, in_sync: List[str], epoch: int) -> None:
    wrong = [name for name in in_sync if name not in settings.appliances]
    if wrong or not in_sync:
        raise WitnessError("--in-sync: %r is not an appliance of the settings" % ",".join(wrong))
    if not 0 < epoch < HIGHEST:
        raise WitnessError("--epoch: use a number greater than the epoch that both appliances show")
    try:
        before = lease.read().epoch
    except WitnessError:
        before = 0  # damaged or missing: the reason for this command
    if epoch <= before:
        raise WitnessError("--epoch: the lease has epoch %d already; use a greater number" % before)
    lease.write(LeaseRecord(epoch, "", tuple(sorted(set(in_sync))), ""))


def _require_place(settings: WitnessSettings, command: str) -> None:
    if (command == "follow") != bool(settings.follows_as):
        place = "the computer with the witness" if settings.follows_as else "a follower"
        raise WitnessError("`%s` is a command for %s; this computer has other settings" % (command, place))


def main(arguments: List[str]) -> int:
    parser = argparse.ArgumentParser(description="The witness of two appliances, on the robot's computer.")
    parser.add_argument("command", choices=("shut", "serve", "follow", "begin", "remove"))
    parser.add_argument("--settings", default=SETTINGS, help="default: %(default)s")
    parser.add_argument("--backend", choices=("nft", "iptables"), help="default: nft, on Linux 4.18 or newer")
    parser.add_argument("--in-sync", default="", help="begin: the appliances that have all data, such as a,b")
    parser.add_argument("--epoch", type=int, default=0, help="begin: greater than both appliances show")
    chosen = parser.parse_args(arguments)
    try:
        if chosen.command == "begin":
            backend = ""  # it changes no rule
        else:
            backend = chosen.backend or chosen_backend(platform.release(), shutil.which)
        if chosen.command == "remove":
            remove_rules(backend)  # even if the settings are damaged
            return 0
        settings = read_settings(chosen.settings)
        lease = LeaseFile(settings.state, tuple(sorted(settings.appliances)))
        if chosen.command == "shut":
            _shut(settings, backend)
            return 0
        _require_place(settings, chosen.command)
        with lease:
            if chosen.command == "begin":
                begin(settings, lease, [name for name in chosen.in_sync.split(",") if name], chosen.epoch)
            else:
                (serve if chosen.command == "serve" else follow)(settings, backend, lease)
    except (WitnessError, OSError) as error:
        sys.stderr.write("witness.py: %s\n" % error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
