"""`rosrv standby join` on the appliance that has all data: make the keys and the files of all machines."""

import contextlib
import json
import os
import secrets
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib.resources import files
from ipaddress import IPv4Address
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import typer
from msgspec.structs import replace

from appliance.base.atomic_files import write_whole
from appliance.base.owner_access import acting_as_owner
from appliance.cli.connection.admin_client import QUICK_SECONDS, AdminSocket, NotRunningError
from appliance.cli.output import moment, say_json, usage_error
from appliance.cli.up_inputs import read_node_ports
from appliance.configuration.config_sources import resolve
from appliance.configuration.settings import Settings, load_resolved
from appliance.features.standby.link_certificates import make_link_certificate
from appliance.features.standby.membership import (
    LEFT_FILE,
    Membership,
    MembershipError,
    load_membership,
    path_of,
    save_membership,
)
from appliance.features.standby.process import EPOCH, stored_epoch
from appliance.features.standby.requests import StandbyWanted
from appliance.features.standby.witness.one_file import witness_program
from appliance.features.standby.witness.settings import settings_of
from appliance.ipsec.authority_key import is_encrypted
from appliance.ipsec.brought_authority import FOLDER
from appliance.ipsec.certificate_authority import CERTIFICATE_FILE, KEY_FILE
from appliance.supervisor.errors import StartError
from appliance.supervisor.state_directory import ADMIN_SOCKET, STORED, foreign
from rosmop.tool.terminal import refusal, say

# Bring the key of an authority, encrypted with a passphrase, to the other appliance.
#
# The other appliance keeps it beside its own authority (`ipsec/brought_authority.py`).


class SealedAuthority(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An authority's certificate, and its private key encrypted with a passphrase (both PEM)."""

    certificate: str
    key: str


def sealed_authority(signer: Path) -> SealedAuthority | None:
    path = signer / KEY_FILE
    key = path.read_bytes() if path.exists() else b""
    if not is_encrypted(key):
        return None
    return SealedAuthority((signer / CERTIFICATE_FILE).read_text(encoding="ascii"), key.decode("ascii"))


def keep_sealed(signer: Path, sealed: SealedAuthority, owner: tuple[int, int] | None) -> None:
    if not is_encrypted(sealed.key.encode()):
        raise ValueError("the key of the authority is not encrypted: set ipsec.ca_passphrase_file there")
    folder = signer / FOLDER
    for made in (signer, folder):
        with contextlib.suppress(FileExistsError):
            made.mkdir(mode=0o700)
            if owner is not None:
                os.chown(made, *owner)
    write_whole(folder / CERTIFICATE_FILE, sealed.certificate.encode(), 0o644, owner)
    write_whole(folder / KEY_FILE, sealed.key.encode(), 0o600, owner)


# Make the memberships of two appliances, and the kits for the robot's computers. No I/O.
#
# All keys and the lease file are new each time: a new kit never changes the lease of an earlier kit, and an old kit
# that is installed again grants nothing.

WITNESS_PORT = 7411
_STATE = "/var/lib/rosrv-witness"
_SHUT = "rosrv-witness-shut.service"


@dataclass(frozen=True, kw_only=True)
class PairPlan:
    """The decisions of an operator; `address` and `name` are those of the appliance that has all data."""

    name: str
    address: str
    other: str
    other_address: str
    witness: str
    fixed: str
    port: int
    ports: tuple[str, ...]
    """Ports and ranges, such as `11311` and `19001-26000`."""
    master_port: int
    epoch: int
    """Greater than that of any earlier lease."""
    followers: Mapping[str, str]


class KitFile(NamedTuple):
    name: str
    text: str
    mode: int


class Kits(NamedTuple):
    """The memberships, and the files of each folder: `witness`, `follower-NAME`."""

    own: Membership
    other: Membership
    folders: Mapping[str, tuple[KitFile, ...]]


def make_kits(plan: PairPlan) -> Kits:
    peer_key = secrets.token_hex(32)
    keys = {name: secrets.token_hex(32) for name in (plan.name, plan.other)}
    links = {name: make_link_certificate() for name in keys}
    addresses = {plan.name: plan.address, plan.other: plan.other_address}

    def membership(name: str, other: str) -> Membership:
        return Membership(
            name=name,
            other=other,
            address=addresses[name],
            other_address=addresses[other],
            fixed=plan.fixed,
            witness=plan.witness,
            witness_port=WITNESS_PORT,
            port=plan.port,
            ports=plan.ports,
            witness_key=keys[name],
            peer_key=peer_key,
            certificate=links[name].certificate,
            key=links[name].key,
            other_certificate=links[other].certificate,
        )

    if plan.name == plan.other:
        raise ValueError(f"both appliances have the name {plan.name}: give --name or --other-name")
    followers = {
        name: {"address": address, "key": secrets.token_hex(32)} for name, address in plan.followers.items()
    }
    common: dict[str, Any] = {
        "listen": f"{plan.witness}:{WITNESS_PORT}",
        "fixed": plan.fixed,
        "ports": plan.ports,
        "state": f"{_STATE}/lease-{secrets.token_hex(4)}",
    }
    appliances = {name: {"address": address} for name, address in addresses.items()}
    with_keys = {name: appliance | {"key": keys[name]} for name, appliance in appliances.items()}
    settings = {"witness": common | {"appliances": with_keys, "followers": followers}}
    for name, follower in followers.items():
        own = {"appliances": appliances, "followers": {name: follower}, "follows_as": name}
        settings[f"follower-{name}"] = common | own
    return Kits(
        membership(plan.name, plan.other),
        membership(plan.other, plan.name),
        {folder: _files(plan, body) for folder, body in settings.items()},
    )


def _files(plan: PairPlan, body: dict[str, Any]) -> tuple[KitFile, ...]:
    settings_of(body)  # the computer accepts what this accepts
    service = "rosrv-witness-follow.service" if "follows_as" in body else "rosrv-witness.service"
    values = {
        "name": plan.name,
        "epoch": str(plan.epoch),
        "lease": body["state"],
        "own": plan.address,
        "other": plan.other_address,
        "fixed": plan.fixed,
        "master": str(plan.master_port),
    }
    package = files("appliance.features.standby")
    found = [
        KitFile("witness.py", witness_program(), 0o755),
        KitFile("witness.json", json.dumps(body, indent=2) + "\n", 0o600),
    ]
    for name in (service, _SHUT, "install.sh", "remove.sh"):
        text = package.joinpath("kit_files", name).read_text("utf-8")
        for key, value in values.items():
            text = text.replace(f"@{key}@", value)
        found.append(KitFile(name, text, 0o755 if name.endswith(".sh") else 0o644))
    return tuple(found)


AGENT_PORTS = range(9090, 9100)
"""Ports at the fixed address for the doors of agents, which may be added later."""

_VERB = "rosrv standby"


@dataclass(frozen=True, kw_only=True)
class JoinOptions:
    """The options of the command line."""

    state: Path
    address: str
    other: str
    witness: str
    fixed: str
    name: str | None
    other_name: str | None
    followers: tuple[str, ...]
    ports: str | None
    port: int
    config: Path | None
    out: Path
    again: bool


def join_first(options: JoinOptions, *, as_json: bool) -> None:
    """Write the kits, then the membership: a failure before that leaves this appliance as it was."""
    path = path_of(options.state)
    _require_state(options.state)
    earlier = existing_membership(path)
    left = existing_membership(path.with_name(LEFT_FILE)) if earlier is None else None
    if earlier is not None and not options.again:
        raise refusal(
            [
                f"{_VERB}: this appliance is already {earlier.name} of a pair with {earlier.other}"
                f" ({earlier.other_address}); --force makes new keys, and all machines must be set up again"
            ]
        )
    if earlier is not None:
        _require_all_data(options.state, earlier)
    plan = _plan(options, _settings(options), earlier or left)
    try:
        kits = make_kits(plan)
    except ValueError as error:
        raise usage_error(str(error), _VERB) from None
    kits = kits._replace(other=_with_authority(kits.other, options.state))
    _write_kits(kits, options.out)
    try:
        save_membership(path, kits.own)
    except OSError as error:
        shutil.rmtree(options.out)
        raise refusal([f"{_VERB}: {path}: {error.strerror}; nothing was changed"]) from None
    _report(plan, options, as_json=as_json)


def _require_all_data(state: Path, earlier: Membership) -> None:
    """Refuse on a running standby. For a stopped appliance, print the age of what becomes the state of both."""
    answer = None
    if (state / ADMIN_SOCKET).exists():
        with contextlib.suppress(NotRunningError):  # its last process was killed
            answer = AdminSocket(state, QUICK_SECONDS).ask(StandbyWanted())
    if answer is None:
        _report_age(state, earlier)
        return
    if answer.ok and answer.unwrap().role == "standby":
        raise usage_error(
            f"this appliance is the standby: run this on the active one, {earlier.other} ({earlier.other_address})."
            " If that machine is lost, stop this appliance first",
            _VERB,
        )
    if not answer.ok and answer.trouble != "unknown":  # a single one, before its restart, has all data
        raise refusal([f"{_VERB}: {answer.error}; try again, or stop this appliance first"])


def _report_age(state: Path, earlier: Membership) -> None:
    with acting_as_owner(state / STORED.parent):
        stored = [path.stat().st_mtime for path in (state / STORED.parent).glob(f"{STORED.name}*")]
    if stored:
        text = f"this appliance last wrote its state on {moment(max(stored))}; it replaces that of {earlier.other}"
        typer.echo(f"{_VERB}: {text}", err=True)


def _with_authority(other: Membership, state: Path) -> Membership:
    signer = state / "signer"
    try:
        with acting_as_owner(signer):
            sealed = sealed_authority(signer)
    except FileNotFoundError:
        return other  # this appliance was never started
    except OSError as error:
        raise refusal([f"{_VERB}: {error.filename or signer}: {error.strerror}; run this as root"]) from None
    if sealed is None:
        return other
    return replace(other, sealed_certificate=sealed.certificate, sealed_key=sealed.key)


def existing_membership(path: Path) -> Membership | None:
    try:
        return load_membership(path)
    except MembershipError as error:
        typer.echo(f"{_VERB}: {error}; it is replaced", err=True)
        return None
    except OSError as error:
        raise refusal([f"{_VERB}: {path}: {error.strerror}; run this as root"]) from None


def _require_state(state: Path) -> None:
    try:
        reason = foreign(state)
    except OSError as error:
        reason = f"{state}: {error.strerror}; run this as root"
    if reason is not None:
        raise refusal([f"{_VERB}: {reason}"])


def _settings(options: JoinOptions) -> Settings:
    running = options.state / "run" / "config.json"
    try:
        if running.exists():
            return load_resolved(running)
    except OSError as error:
        raise refusal([f"{_VERB}: {running}: {error.strerror}; run this as root"]) from None
    return resolve(options.config, os.environ, {"state": options.state})


def _plan(options: JoinOptions, settings: Settings, earlier: Membership | None) -> PairPlan:
    if settings.isolation == "none":
        raise refusal(
            [
                f"{_VERB}: isolation none has no firewall, so a standby could be used before it is active; start the"
                " appliance with isolation netns or container"
            ]
        )
    followers = _followers(options.followers)
    given = {
        "--address": options.address,
        "--other": options.other,
        "--witness": options.witness,
        "--fixed": options.fixed,
    }
    for option, text in (*given.items(), *(("--follower", text) for text in followers.values())):
        try:
            IPv4Address(text)
        except ValueError:
            raise usage_error(
                f"{option} {text!r} is not an IPv4 address, such as 192.168.1.2", _VERB
            ) from None
    try:
        with acting_as_owner(options.state / "lease"):
            epoch = stored_epoch(options.state / "lease" / EPOCH)
    except (OSError, ValueError) as error:
        raise refusal([f"{_VERB}: {error}"]) from None
    # Its audit log and the state of its monitors have the appliance's name.
    name = options.name or (earlier.name if earlier is not None else "a")
    other = earlier.other if earlier is not None and earlier.name == name else "a" if name == "b" else "b"
    return PairPlan(
        name=name,
        address=options.address,
        other=options.other_name or other,
        other_address=options.other,
        witness=options.witness,
        fixed=options.fixed,
        port=options.port,
        ports=_ports(options, settings),
        master_port=settings.listen_address[1],
        epoch=epoch + 1,
        followers=followers,
    )


def _ports(options: JoinOptions, settings: Settings) -> tuple[str, ...]:
    if options.ports is not None:
        return tuple(part.strip() for part in options.ports.split(","))
    try:
        nodes = read_node_ports(settings)
    except StartError as error:
        raise usage_error(f"{error}; give --ports FIRST-LAST, or the appliance's --config", _VERB) from None
    single = [settings.listen_address[1], *(() if settings.api_address is None else settings.api_address[1:])]
    if 0 in single:
        raise usage_error(
            "port 0 differs at each start; choose a port in the configuration, or give --ports", _VERB
        )
    return (*map(str, single), f"{nodes.start}-{nodes.stop - 1}", *_free_of([*single, *nodes]))


def _free_of(taken: Iterable[int]) -> Iterator[str]:
    """Return the ranges of agents' ports without those that are taken: the rules of the robot allow no overlap."""
    free = sorted(set(AGENT_PORTS) - set(taken))
    for _, run in groupby(enumerate(free), lambda one: one[1] - one[0]):
        ports = [port for _, port in run]
        yield f"{ports[0]}-{ports[-1]}" if len(ports) > 1 else str(ports[0])


def _followers(texts: tuple[str, ...]) -> dict[str, str]:
    followers: dict[str, str] = {}
    for text in texts:
        name, separator, address = text.partition("=")
        if not separator or name in followers:
            raise usage_error(f"--follower {text!r}: write NAME=ADDRESS, each name once", _VERB)
        followers[name] = address
    return followers


def _write_kits(kits: Kits, out: Path) -> None:
    try:
        out.mkdir(mode=0o700, parents=True)
    except FileExistsError:
        raise usage_error(
            f"{out} already exists: remove it, or name another folder with --output", _VERB
        ) from None
    except OSError as error:
        raise usage_error(f"{out}: {error.strerror}", _VERB) from None
    try:
        text = msgspec.json.format(msgspec.json.encode(kits.other))
        _write(out / f"standby-{kits.other.name}.json", text, 0o600)
        for folder, members in kits.folders.items():
            (out / folder).mkdir(mode=0o700)
            for member in members:
                _write(out / folder / member.name, member.text.encode(), member.mode)
    except OSError as error:
        shutil.rmtree(out)
        raise refusal([f"{_VERB}: {out}: {error.strerror}; nothing was changed"]) from None


def _write(path: Path, data: bytes, mode: int) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, mode)
    with os.fdopen(descriptor, "wb") as file:
        os.fchmod(descriptor, mode)  # independent of the umask
        file.write(data)


def _report(plan: PairPlan, options: JoinOptions, *, as_json: bool) -> None:
    out, given = options.out, f"standby-{plan.other}.json"
    if as_json:
        say_json(
            {
                "name": plan.name,
                "other": plan.other,
                "ports": list(plan.ports),
                "out": str(out),
                "followers": list(plan.followers),
            }
        )
        return
    say(
        f"{plan.name} ({plan.address}) and {plan.other} ({plan.other_address}) are a pair at their next start."
    )
    say(f"At {plan.fixed} the robot reaches the active one: TCP {', '.join(plan.ports)}.")
    say("Next:")
    say(
        f"1. Copy {out / given} to {plan.other}. There: rosrv standby join {given}, then start the appliance."
    )
    say(f"2. Copy {out / 'witness'} to the robot ({plan.witness}). There: sudo ./install.sh")
    for name, address in plan.followers.items():
        say(f"   Copy {out / f'follower-{name}'} to {name} ({address}). There: sudo ./install.sh")
    say("3. Restart this appliance. From step 2 until it has started, the robot's nodes reach no appliance.")
    say(f"4. Start the nodes with ROS_MASTER_URI=http://{plan.fixed}:{plan.master_port}")
    say(f"5. Check both: rosrv standby status. Then remove {out}: it has private keys.")
