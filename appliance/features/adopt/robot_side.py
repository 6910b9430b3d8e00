"""Do as root what `rosrv adopt` and `rosrv release` do on the robot: record, drop-in, the first policy's mode."""

import asyncio
import os
import shutil
import subprocess
from collections.abc import Iterable
from contextlib import suppress
from ipaddress import ip_address
from pathlib import Path

import structlog

from appliance.base.atomic_files import write_whole
from appliance.base.shipped import SHIPPED
from appliance.cli.standing import link_address
from appliance.configuration.settings import Settings, load_resolved
from appliance.features.adopt.adopt_check import CheckedRobot, sockets_of
from appliance.features.adopt.adopt_record import AdoptRecord, load_record
from appliance.features.adopt.machine_side import master_of
from appliance.network import interfaces
from appliance.network.listening_sockets import TcpSocket
from appliance.network.namespaces import Namespace, NetworkError
from appliance.network.socket_owners import is_node, node_sockets
from appliance.network.vendor_masters import add_to_set
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.policy_findings import PolicyError
from appliance.rpc.graph_inventory import GraphInventory
from appliance.rpc.graph_reader import SurveyError, SurveyLimits, survey

MASTER_PORT = 11311
WAITS = "waits: "
"""The beginning of each answer of an appliance that waits for a port."""

AUDIT_ONLY = (
    "\n[Options]\naudit-only = all             # records denials, and lets them pass: `rosrv policy learn`\n"
)
_DROP_IN = "50-rosrv-adopt.conf"
_UNITS = Path("/etc/systemd/system")
_RUNNING = Path("/run/systemd/system")
_NFT = "/usr/sbin/nft"
_SECONDS = 20.0

log = structlog.get_logger()


def running_settings(state: Path) -> Settings | None:
    """Return the settings of the appliance that runs or waits in this state directory."""
    with suppress(OSError, ValueError):
        return load_resolved(state / "run" / "config.json")
    return None


def robot_state(state: Path, settings: Settings | None, *, seconds: float = 20.0) -> CheckedRobot:
    """Read the robot. Raises `NetworkError`."""
    host = Namespace.own()
    port = MASTER_PORT if settings is None else settings.listen_address[1]
    own = frozenset(text.partition("/")[0] for text in interfaces.addresses(host))
    link = link_address() or "10.111.0.1"
    master = master_of(host, port)
    record = load_record(state)
    sockets = sockets_of(host)
    return CheckedRobot(
        port=port,
        record=record,
        master=master,
        inventory=_inventory(port, seconds) if master is not None or record.wanted else None,
        own=own,
        sockets=sockets,
        policy=_policy(settings, link, own),
        robot=ip_address(link),
        node_ports=_node_ports(host, sockets, port),
    )


def _node_ports(host: Namespace, sockets: Iterable[TcpSocket], master_port: int) -> frozenset[int]:
    found = node_sockets(host, {socket.port for socket in sockets if socket.listens}, master_port)
    return frozenset(port for port, process in found.items() if is_node(process))


def _inventory(port: int, seconds: float) -> GraphInventory | None:
    with suppress(SurveyError):
        return asyncio.run(survey(f"http://127.0.0.1:{port}", SurveyLimits(whole=seconds, sample=0.0)))
    return None


def _policy(settings: Settings | None, link: str, own: Iterable[str]) -> Policy | None:
    if settings is None:
        return None
    with suppress(OSError, PolicyError, UnicodeError):
        text = settings.policy.read_text(encoding="utf-8")
        return compile_policy(
            text, file=str(settings.policy), robot=[ip_address(one) for one in (link, *own)]
        )
    return None


# --- audit-only first ---


def make_audit_only(policy: Path) -> bool:
    """Make the shipped policy audit-only; return False if the file is another policy, which stays as it is.

    Raises `OSError`.
    """
    text = policy.read_text(encoding="utf-8")
    shipped = (SHIPPED / "policies" / "default.ini").read_text(encoding="utf-8")
    if text == shipped + AUDIT_ONLY:
        return True
    if text != shipped:
        return False
    write_policy(policy, (text + AUDIT_ONLY).encode())
    return True


def write_policy(policy: Path, text: bytes) -> None:
    """Replace the text of a policy's file. Raises `OSError`."""
    found = policy.stat()
    write_whole(policy, text, found.st_mode & 0o777, (found.st_uid, found.st_gid))


# --- the drop-in ---


def drop_in(unit: str) -> Path:
    return _UNITS / f"{unit}.d" / _DROP_IN


def write_drop_in(record: AdoptRecord) -> Path | None:
    """Keep the unit of the robot's own master working beside the appliance; return the file, or None without need.

    Without the appliance's rules, the command fails, and the unit starts as ever.
    """
    if not record.group or not record.unit or not _RUNNING.is_dir():
        return None
    file = drop_in(record.unit)
    command = add_to_set(record.group).replace("\\", "\\\\").replace("%", "%%")
    text = f"[Service]\nExecStartPre=-+{_NFT} '{command}'\n"
    try:
        file.parent.mkdir(mode=0o755, exist_ok=True)
        write_whole(file, text.encode(), 0o644)
    except OSError as error:
        raise NetworkError(f"{file} cannot be written: {error.strerror}") from error
    _reload_units()
    return file


def remove_drop_ins() -> None:
    """Remove the file of `write_drop_in`, also of an adoption that a loss of power ended before its release did."""
    found = list(_UNITS.glob(f"*.d/{_DROP_IN}"))
    for file in found:
        file.unlink(missing_ok=True)
        with suppress(OSError):
            file.parent.rmdir()
    if found:
        _reload_units()


def _reload_units() -> None:
    systemctl = shutil.which("systemctl")
    if systemctl is not None and os.geteuid() == 0:
        with suppress(OSError, subprocess.TimeoutExpired):
            subprocess.run([systemctl, "daemon-reload"], capture_output=True, timeout=_SECONDS, check=False)
