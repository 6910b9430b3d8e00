"""List the versions of this program and its parts, for bug reports and the site's inventory."""

import functools
import hashlib
import json
import platform
import re
from collections.abc import Iterator
from email.message import Message
from email.parser import HeaderParser
from importlib.metadata import distributions
from pathlib import Path
from typing import cast

import appliance
from appliance.base.shipped import DPKG, SHIPPED
from appliance.channel.answers.inventory_answers import Inventory, Part

# The packages of packages.txt whose programs run on the robot's computer.
RUNS = (
    "python3-rosmaster", "rosout", "iproute2", "iptables", "nftables", "charon-systemd",
    "libstrongswan-standard-plugins", "libcharon-extra-plugins", "strongswan-swanctl", "libseccomp2", "tzdata",
)  # fmt: skip
_STANDS_ON = {*RUNS, "python3", "libc6", "rosrv"}
_LICENCE = re.compile(r"^License:[ \t]*+(\S[^\n]*+)$", re.MULTILINE)
_COMMON = re.compile(r"/usr/share/common-licenses/([A-Za-z0-9.-]*[A-Za-z0-9])")


@functools.cache
def inventory() -> Inventory:
    build, listed = SHIPPED / "build.json", SHIPPED / "sbom.cdx.json"
    return Inventory(
        version=appliance.__version__,
        build=json.loads(build.read_text()) if build.exists() else None,
        python=platform.python_version(),
        system=_system(),
        kernel=platform.release(),
        machine=platform.machine(),
        parts=sorted([*_python(), *_debian()], key=lambda part: (part.kind, part.name)),
        parts_list=hashlib.sha256(listed.read_bytes()).hexdigest() if listed.exists() else None,
    )


def debian_packages(status: str) -> Iterator[Message]:
    for stanza in status.strip().split("\n\n"):
        fields = HeaderParser().parsestr(stanza)
        if fields["Status"] == "install ok installed":
            yield fields


def debian_licences(text: str) -> list[str]:
    """Return the licences in Debian's machine-readable format, or in prose."""
    return sorted(set(_LICENCE.findall(text) if "Format:" in text else _COMMON.findall(text)))


def python_licences(fields: Message) -> list[str]:
    classified = [
        str(classifier).rpartition(" :: ")[2]
        for classifier in fields.get_all("Classifier", [])
        if str(classifier).startswith("License ::")
    ]
    said = str(fields["License-Expression"] or fields["License"] or "")
    return [said] if said and "\n" not in said else classified


def _python() -> Iterator[Part]:
    for found in distributions():
        fields = cast(Message, found.metadata)
        yield Part("python", found.name.lower(), found.version, python_licences(fields))


def _debian() -> Iterator[Part]:
    try:
        status = (DPKG / "status").read_text(errors="replace")
    except FileNotFoundError:
        return
    for fields in debian_packages(status):
        if fields["Package"] in _STANDS_ON:
            copyright_ = Path("/usr/share/doc", fields["Package"], "copyright")
            text = copyright_.read_text(errors="replace") if copyright_.exists() else ""
            yield Part("debian", fields["Package"], fields["Version"], debian_licences(text))


def _system() -> str:
    try:
        return platform.freedesktop_os_release()["PRETTY_NAME"]
    except (OSError, KeyError):  # a system without os-release
        return platform.system()
