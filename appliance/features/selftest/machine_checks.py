"""Check whether this machine can run the appliance: programs, users, namespaces, firewall, tunnels, ports.

The checks change nothing outside a network namespace that they create and delete.
"""

import os
import pwd
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from appliance.configuration.settings import Settings
from appliance.features.selftest.selftest_findings import SelftestFinding, fail, ok, run_check, skip, warn
from appliance.network import interfaces
from appliance.network.esp import TUN, choose_esp
from appliance.network.firewall.backend import BackendMissingError, FirewallError
from appliance.network.firewall.backend_check import prove
from appliance.network.firewall.iptables import IptablesBackend
from appliance.network.firewall.nft import NftBackend
from appliance.network.namespaces import Namespace, NetworkError, read_only_settings, shared_network
from appliance.supervisor.errors import StartError
from appliance.supervisor.port_check import require_free
from appliance.supervisor.roles import ROS_PROGRAMS
from appliance.supervisor.users import NUMERIC_IDS

_SECONDS = 10.0
_CHARON = Path("/usr/sbin/charon-systemd")


def machine(settings: Settings, *, running: bool) -> Iterator[SelftestFinding]:
    """Check this machine. `running` is whether an appliance with these settings already uses its ports."""
    yield from run_check("python", _python)
    yield from run_check("programs", programs)
    yield from run_check("users", _users)
    yield from run_check("kernel", lambda: kernel(settings))
    if running:
        yield ok("ports", "in use by the running appliance")
    else:
        yield from run_check("ports", lambda: _ports(settings))


def _python() -> Iterator[SelftestFinding]:
    version = ".".join(map(str, sys.version_info[:3]))
    yield ok("python", f"{version}, {sys.executable}")


def programs() -> Iterator[SelftestFinding]:
    for name, path, package, missing in (
        *((path.name, path, package, fail) for path, package in ROS_PROGRAMS.items()),
        ("charon", _CHARON, "charon-systemd", warn),
        ("nft", None, "nftables", warn),
        ("ip", None, "iproute2", warn),
    ):
        found = path if path is not None and path.exists() else shutil.which(name)
        if not found:
            yield missing(name, "not installed", f"apt install {package}")
        else:
            yield ok(name, f"{found}{_version(package)}")


def _version(package: str) -> str:
    query = ["dpkg-query", "-W", "-f=${Version}", package]
    try:
        done = subprocess.run(query, capture_output=True, text=True, timeout=_SECONDS, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return f" ({package} {done.stdout})" if done.returncode == 0 and done.stdout else ""


def _users() -> Iterator[SelftestFinding]:
    named, numbered = [], []
    for user, number in NUMERIC_IDS.items():
        if _name_of_user(user) is not None:
            named.append(user)
        elif (owner := _name_of_number(number)) is not None:
            yield fail(
                "users",
                f"uid {number}, meant for {user}, belongs to the user {owner}",
                f"create the user: useradd --system {user}",
            )
        else:
            numbered.append(str(number))
    there = f"{len(named)} by name" if named else ""
    rest = f"{len(numbered)} by number ({numbered[0]} to {numbered[-1]})" if numbered else ""
    yield ok("users", ", ".join(filter(None, (there, rest))) or "none missing")


def _name_of_user(user: str) -> str | None:
    try:
        return pwd.getpwnam(user).pw_name
    except KeyError:
        return None


def _name_of_number(number: int) -> str | None:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return None


def kernel(settings: Settings) -> Iterator[SelftestFinding]:
    if settings.isolation == "none":
        yield warn(
            "isolation",
            "isolation none: no firewall hides the ROS master",
            "use netns or container on a robot",
        )
    if settings.isolation == "container":
        yield from run_check("network", _own_network)
    if os.geteuid() != 0:
        yield skip("kernel", "checks of namespaces and the firewall need root", "sudo rosrv selftest")
        return
    namespace = Namespace(f"rosrv-selftest-{os.getpid()}")
    try:
        namespace.create()
    except NetworkError as error:
        outcome = fail if settings.isolation == "netns" else skip
        yield outcome(
            "namespaces", str(error), "give the machine or container CAP_SYS_ADMIN, or use container"
        )
        return
    try:
        yield ok("namespaces", "a network namespace can be created")
        if settings.isolation == "netns":
            yield from run_check("sysctl", lambda: kernel_settings(read_only_settings()))
        yield from run_check("veth", lambda: _veth(namespace))
        interfaces.set_link(namespace, "lo", up=True)
        yield from run_check("firewall", lambda: _firewall(settings, namespace))
        yield from run_check("esp", lambda: _esp(namespace))
    finally:
        namespace.delete()


def kernel_settings(read_only: list[str]) -> Iterator[SelftestFinding]:
    if read_only:
        text = f"{', '.join(read_only)} cannot be written: /proc/sys is read-only"
        yield fail(
            "sysctl", text, "mount /proc/sys writable, or use isolation container in a container of its own"
        )
    else:
        yield ok("sysctl", "the kernel's network settings can be written")


def _own_network() -> Iterator[SelftestFinding]:
    if reason := shared_network():
        yield fail("network", reason, "give the container its own network")
    else:
        yield ok("network", "the firewall affects only the appliance's own network")


def _veth(namespace: Namespace) -> Iterator[SelftestFinding]:
    try:
        interfaces.create_veth(namespace, "try0", namespace, "try1")
    except NetworkError as error:
        yield fail("veth", str(error), "load the kernel module: modprobe veth")
    else:
        yield ok("veth", "a veth pair can be created")


def _firewall(settings: Settings, namespace: Namespace) -> Iterator[SelftestFinding]:
    refused, advice = (
        [],
        "load nf_tables, or ip_tables with xt_owner; `isolation: none` goes without a firewall",
    )
    for backend in (NftBackend(namespace), IptablesBackend(namespace)):
        if settings.firewall.backend not in ("auto", backend.name):
            continue
        try:
            prove(backend, namespace)
        except FirewallError as error:
            refused.append(f"{backend.name}: {error}")
            if isinstance(error, BackendMissingError):
                advice = f"load nf_tables, or: {error}"
        else:
            yield ok("firewall", f"{backend.name}: a test rule rejected another user and accepted this one")
            return
    yield fail("firewall", "; ".join(refused), advice)


def _esp(namespace: Namespace) -> Iterator[SelftestFinding]:
    try:
        where = choose_esp(namespace)
    except NetworkError as error:
        yield warn("esp", str(error), "only IPsec tunnels need it")
    else:
        tun = "" if TUN.exists() else f", {TUN} does not exist"
        if where == "kernel":
            yield ok("esp", f"in the {where}{tun}")
        elif os.access(TUN, os.R_OK | os.W_OK):
            yield ok("esp", f"in {where}, over {TUN}, which charon's user will own")
        else:
            yield warn("esp", f"in {where}, and {TUN} cannot be opened", "load the kernel module `tun`")


def _ports(settings: Settings) -> Iterator[SelftestFinding]:
    places = {"RVMaster": settings.listen_address, "ROS master": ("127.0.0.1", settings.rosmaster_port)}
    if settings.api_address is not None:
        places["REST"] = settings.api_address
    for name, (host, port) in places.items():
        try:
            require_free(host, port)
        except StartError as error:
            what = re.sub(r": stop that.*", "", str(error))
            yield fail(f"port of {name}", what, "stop that program, or choose another port in appliance.yaml")
        else:
            yield ok(f"port of {name}", f"{host}:{port} is free" if port else "any")
