import hashlib
import io
import json
import os
import re
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest

from appliance import __version__
from distribution.checkout import ROOT
from examples.landshark.lab import Lab
from tests.package.conftest import LATER, build_later, elsewhere
from tests.support.docker import BASE, Engine, MachineInside, builder
from tests.support.nodes import RosSession, need_ros

pytestmark = pytest.mark.timeout(1800)  # the image is built
NAME = f"rosrv/appliance:{__version__}"
OPTIONS = ("--network", "host", "--build-arg", f"BASE={BASE}")
INSIDE = """\
from importlib.metadata import distributions
import re
for found in distributions():
    print(re.sub(r"[-_.]+", "-", found.name).lower(), found.version)
"""
# Files unknown to dpkg and Python's installer, except links of Debian's alternatives.
NOBODYS = r"""
import os, re, sys
from importlib.metadata import distributions
from pathlib import Path

def real(path):
    return os.path.join(os.path.realpath(os.path.dirname(path)), os.path.basename(path))

owned = {real(line) for lists in Path("/var/lib/dpkg/info").glob("*.list") for line in lists.read_text().splitlines()}
owned |= {real(os.path.abspath(found.locate_file(one))) for found in distributions() for one in found.files or ()}
device = os.stat("/").st_dev
for folder, folders, files in os.walk("/"):
    folders[:] = [name for name in folders if os.stat(os.path.join(folder, name)).st_dev == device]
    for name in files:
        path = os.path.join(folder, name)
        if os.path.islink(path) and os.readlink(path).startswith("/etc/alternatives/"):
            continue
        source = re.sub(r"/__pycache__/([^/]+)\.cpython-\d+\.pyc$", r"/\1.py", path)
        if real(path) not in owned and real(source) not in owned and os.lstat(path).st_dev == device:
            print(path)
"""
# Those that the image contains: our own files, files of the build, files that packages write during setup.
EXPECTED = re.compile(
    r"/opt/rosrv/lib/python3\.11/site-packages/(appliance|roswire|rosmop)/.+|/opt/rosrv/share/rosrv/.+"
    r"|/opt/rosrv/(bin/(python\S*|rosrv)|pyvenv\.cfg|lib64)|/etc/.+|/usr/local/share/ca-certificates/.+\.crt"
    r"|/var/lib/(apt|dpkg|pam|python|sgml-base|systemd|xml-core)/.+|/var/lib/shells\.state|/usr/share/info/dir"
    r"|/root/\.(bashrc|profile)|/\.dockerenv"
)


@pytest.fixture(scope="module")
def engine() -> Iterator[Engine]:
    with builder(clock=True) as engine:
        yield engine


@pytest.fixture(scope="module")
def unpacked(engine: Engine, tmp_path_factory: pytest.TempPathFactory) -> Path:
    command = [sys.executable, "-m", "distribution.site", *OPTIONS]
    environment = os.environ | {"DOCKER_HOST": engine.address}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    folder = tmp_path_factory.mktemp("site")
    subprocess.run(
        ["tar", "--extract", "--file", str(ROOT / done.stdout.split()[-1])], cwd=folder, check=True
    )
    engine.docker("rmi", "--force", NAME)
    engine.docker("load", "--input", str(next(folder.glob("*/rosrv-image_*.tar"))), timeout=300)
    return folder / f"rosrv-{__version__}"


@pytest.fixture(scope="module")
def parts(unpacked: Path) -> list[dict[str, Any]]:
    components: list[dict[str, Any]] = json.loads(next(unpacked.glob("*.cdx.json")).read_text())["components"]
    return components


def run(engine: Engine, *command: str, text: str = "") -> str:
    options = ("run", "--rm", "--interactive", "--network", "none", "--entrypoint", command[0], NAME)
    return engine.docker(*options, *command[1:], text=text).stdout


def of(parts: list[dict[str, Any]], kind: str) -> set[tuple[str, str]]:
    return {(part["name"], part["version"]) for part in parts if part["purl"].startswith(f"pkg:{kind}/")}


def test_every_part_is_in_the_list(engine: Engine, unpacked: Path, parts: list[dict[str, Any]]) -> None:
    listed = run(engine, "dpkg-query", "--show", "--showformat", "${Package} ${Version}\\n")
    assert {tuple(line.split()) for line in listed.splitlines()} == of(parts, "deb")
    installed = run(engine, "/opt/rosrv/bin/python", "-P", "-", text=INSIDE)
    assert {tuple(line.split()) for line in installed.splitlines()} == of(parts, "pypi")
    manifest = json.loads((ROOT / "appliance/api/console/vendor/manifest.json").read_text())
    bundled = {
        (one["name"], one["version"]) for file in manifest["files"].values() for one in file["packages"]
    }
    assert of(parts, "npm") == bundled


def test_every_file_belongs_to_a_part(engine: Engine, unpacked: Path) -> None:
    python = ("/opt/rosrv/bin/python", "-P", "-")
    assert [
        line for line in run(engine, *python, text=NOBODYS).splitlines() if not EXPECTED.fullmatch(line)
    ] == []
    ours = "/opt/rosrv/lib/python3.11/site-packages"
    spy = f"touch /usr/bin/spy {ours}/spy.py; exec {' '.join(python)}"
    found = run(engine, "sh", "-c", spy, text=NOBODYS).splitlines()
    assert {one for one in found if not EXPECTED.fullmatch(one)} == {"/usr/bin/spy", f"{ours}/spy.py"}


def test_every_part_has_a_licence(parts: list[dict[str, Any]]) -> None:
    assert [part["name"] for part in parts if not part.get("licenses")] == []
    unread = [part["name"] for part in parts if "see /usr/share/doc" in json.dumps(part["licenses"])]
    assert len(unread) < 10, unread


def test_the_list_is_valid(unpacked: Path) -> None:
    folder = files("cyclonedx.schema._res")
    names = [f"{name}.SNAPSHOT.schema.json" for name in ("bom-1.6", "spdx", "jsf-0.82")]
    schemas = {name: json.loads((folder / name).read_text()) for name in names}
    registry = jsonschema_rs.Registry(
        [(f"http://cyclonedx.org/schema/{name}", schema) for name, schema in schemas.items()]
    )
    validator = jsonschema_rs.Draft7Validator(schemas[names[0]], registry=registry)
    found = json.loads(next(unpacked.glob("*.cdx.json")).read_text())
    assert [str(error.message) for error in validator.iter_errors(found)] == []


def test_it_reports_its_version_and_commit(engine: Engine, unpacked: Path) -> None:
    labels = engine.inspect(NAME)["Config"]["Labels"]
    build = json.loads(run(engine, "rosrv", "version", "--json"))["build"]
    assert build["kind"] == "image"
    assert (build["version"], build["commit"]) == (__version__, labels["org.opencontainers.image.revision"])
    assert labels["org.opencontainers.image.version"] == __version__
    inside = run(engine, "cat", "/opt/rosrv/share/rosrv/sbom.cdx.json")
    assert inside == next(unpacked.glob("*.cdx.json")).read_text()


def test_the_packages_match_the_lock(parts: list[dict[str, Any]]) -> None:
    lock = (ROOT / "distribution/image-packages.lock").read_text().splitlines()
    pinned = {tuple(line.split("=", 1)) for line in lock if not line.startswith("#")}
    assert len(pinned) > 50
    assert pinned <= of(parts, "deb")


def test_the_archive_has_all_that_a_site_needs(unpacked: Path) -> None:
    done = subprocess.run(
        ["sha256sum", "--check", "--quiet", "SHA256SUMS"], cwd=unpacked, capture_output=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, b"")
    named = {line.split("  ")[1] for line in (unpacked / "SHA256SUMS").read_text().splitlines()}
    assert named == {str(path.relative_to(unpacked)) for path in unpacked.rglob("*") if path.is_file()} - {
        "SHA256SUMS"
    }
    assert named >= {
        "compose.yaml",
        "compose.host.yaml",
        "policies/containers.ini",
        "docs/install.md",
        "LICENSE",
    }


def test_the_archive_protects_a_robot(unpacked: Path, tmp_path: Path) -> None:
    need_ros()
    with Lab("rosrv-site") as lab:
        machine = lab.host("machine", "10.79.0.1/24")
        with Engine(machine, data=tmp_path / "docker") as engine:
            assert engine.docker("images", "--quiet").stdout == ""
            engine.docker("load", "--input", str(next(unpacked.glob("rosrv-image_*.tar"))), timeout=300)
            compose = engine.compose(unpacked, "site", "compose.yaml", "compose.host.yaml")
            compose("up", "--detach", "--no-build", "appliance")
            compose.wait_healthy()
            with RosSession("http://172.29.76.2:11311", tmp_path, MachineInside(machine)) as ros:
                listener = ros.listener("rospy", "/chatter", name="listener")
                ros.talker("rospy", "/chatter", name="talker")
                listener.wait_for(event="received")
            registered = {one["caller_id"] for one in compose.audit("--event", "registered")}
            assert registered >= {"/listener", "/talker"}


def test_two_builds_are_the_same(engine: Engine, unpacked: Path, tmp_path: Path) -> None:
    """The second build is two days later, without a cache, in another folder, with private files."""
    engine.go_ahead(LATER)
    folder = elsewhere(tmp_path / "elsewhere")
    second = build_later("distribution.image", *OPTIONS, folder=folder, DOCKER_HOST=engine.address)
    assert differences(next(unpacked.glob("rosrv-image_*.tar")), second)[:50] == []


def differences(first: Path, second: Path) -> list[str]:
    if first.read_bytes() == second.read_bytes():
        return []
    with tarfile.open(first) as one, tarfile.open(second) as other:
        named = [json.loads(content(archive, "manifest.json"))[0]["Layers"] for archive in (one, other)]
        found = []
        for layers in zip(*named, strict=True):
            here, there = (
                entries(content(archive, layer)) for archive, layer in zip((one, other), layers, strict=True)
            )
            for name in sorted(here.keys() | there.keys()):
                pairs = here.get(name, {}).items() ^ there.get(name, {}).items()
                found += [f"{name}: {aspect}" for aspect in sorted({aspect for aspect, _ in pairs})]
    return found or ["the configuration"]


def content(archive: tarfile.TarFile, name: str) -> bytes:
    file = archive.extractfile(name)
    assert file is not None, name
    return file.read()


def entries(layer: bytes) -> dict[str, dict[str, object]]:
    found: dict[str, dict[str, object]] = {}
    with tarfile.open(fileobj=io.BytesIO(layer)) as members:
        for member in members:
            about = {key: getattr(member, key) for key in ("mode", "uid", "gid", "mtime", "size", "linkname")}
            if member.isreg():
                about["content"] = hashlib.sha256(content(members, member.name)).hexdigest()
            found[member.name] = about
    return found
