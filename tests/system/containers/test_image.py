import io
import json
import re
import stat
import subprocess
import tarfile
from collections.abc import Iterator

import pytest

from appliance.supervisor.users import NUMERIC_IDS
from distribution.extension import IN_PLACE
from tests.support.docker import APPLIANCE, BASE, DEMO, ROOT
from tests.system.containers.conftest import Site

pytestmark = pytest.mark.timeout(1500)  # for the first test: the images are built

DOCKERFILE = (ROOT / "Dockerfile").read_text()
TOOLS = re.compile(
    r"/(gcc|cc|c\+\+|g\+\+|ld|make|pip3?|git|curl|wget|nc|telnet|gdb|strace|tcpdump)(-[0-9.]+)?$"
)
CACHES = ("/var/lib/apt/lists/", "/var/cache/apt/", "/root/.cache/", "/tmp/")
SECRET = re.compile(rb"-----BEGIN [A-Z ]*PRIVATE KEY-----\s+[A-Za-z0-9+/=\s]{60}")
MAX_MEGABYTES = (
    420  # for the appliance's image, including the base of the tests (without Debian's own trimming)
)


def members(site: Site, image: str) -> Iterator[tuple[str, tarfile.TarInfo, bytes]]:
    saved = site.engine.directory / "image.tar"
    site.engine.docker("save", "--output", str(saved), image, timeout=300)
    try:
        with tarfile.open(saved) as whole:
            manifest = json.load(whole.extractfile("manifest.json") or io.BytesIO())
            for layer in manifest[0]["Layers"]:
                with tarfile.open(fileobj=whole.extractfile(layer)) as files:
                    for entry in files:
                        data = files.extractfile(entry) if entry.isfile() else None
                        yield "/" + entry.name.removeprefix("./"), entry, data.read(1 << 20) if data else b""
    finally:
        saved.unlink()


@pytest.fixture(scope="module")
def contents(site: Site) -> list[tuple[str, tarfile.TarInfo, bool]]:
    return [(path, entry, bool(SECRET.search(data))) for path, entry, data in members(site, APPLIANCE)]


def run(site: Site, *command: str, image: str = APPLIANCE) -> str:
    return site.engine.docker("run", "--rm", "--entrypoint", command[0], image, *command[1:]).stdout


def test_the_base_image_is_pinned_by_digest() -> None:
    bases = re.findall(r"^FROM (\S+)", DOCKERFILE, re.MULTILINE)
    assert set(bases) == {"${BASE}", "appliance"}
    assert re.search(r"^ARG BASE=debian:12-slim@sha256:[0-9a-f]{64}$", DOCKERFILE, re.MULTILINE)


def test_debian_packages_are_those_of_the_list() -> None:
    text = DOCKERFILE.partition("AS appliance\n")[2].partition("&& apt-get clean")[0]
    taken = set(re.findall(r"^ {8}([a-z0-9.+-]+) \\$", text, re.MULTILINE))
    assert len(taken) > 5
    reasons = {line.split()[0] for line in (ROOT / "packages.txt").read_text().splitlines() if line.strip()}
    assert taken - reasons == {"tini"}


def test_there_is_no_compiler_and_no_way_to_fetch_programs(
    contents: list[tuple[str, tarfile.TarInfo, bool]],
) -> None:
    tools = [
        path for path, entry, _ in contents if entry.isfile() and entry.mode & 0o111 and TOOLS.search(path)
    ]
    assert tools == []
    assert not any("/site-packages/pip/" in path for path, _entry, _secret in contents)


def test_it_has_the_compiled_module_but_no_cython(
    contents: list[tuple[str, tarfile.TarInfo, bool]], site: Site
) -> None:
    tools = re.compile(r"/(Cython|cython)[^/]*/|/distribution/|/pump\.c$")
    assert [path for path, _entry, _secret in contents if tools.search(path)] == []
    load = "from appliance.relay.transport import pump; print(pump.__file__)"
    packages = "/opt/rosrv/lib/python3.11/site-packages"
    assert (
        run(site, "/opt/rosrv/bin/python", "-P", "-c", load) == f"{packages}/{IN_PLACE.relative_to(ROOT)}\n"
    )


def test_nothing_of_the_build_is_left(contents: list[tuple[str, tarfile.TarInfo, bool]]) -> None:
    left = [path for path, entry, _ in contents if entry.isfile() and entry.size and path.startswith(CACHES)]
    assert left == []
    ours = [path for path, _, _ in contents if re.search(r"/(tests|\.git|requirements\.lock)(/|$)", path)]
    assert ours == []


def test_there_is_no_private_key(contents: list[tuple[str, tarfile.TarInfo, bool]]) -> None:
    assert [path for path, _, secret in contents if secret] == []
    assert not any(
        path.startswith("/var/lib/rosrv/") and path != "/var/lib/rosrv/" for path, _, _ in contents
    )


def test_no_program_raises_privileges(site: Site) -> None:
    found = run(site, "find", "/", "-xdev", "-type", "f", "-perm", "/6000")
    assert found == ""


def test_only_root_can_change_files(
    contents: list[tuple[str, tarfile.TarInfo, bool]],
) -> None:
    open_to_others = [
        path
        for path, entry, _ in contents
        if entry.isfile() and path.startswith(("/opt", "/etc", "/usr")) and entry.mode & stat.S_IWOTH
    ]
    assert open_to_others == []
    assert [path for path, entry, _ in contents if path.startswith("/opt/") and entry.uid != 0] == []


def test_every_process_finds_its_user(site: Site) -> None:
    lines = run(site, "getent", "passwd").splitlines()
    users = {fields[0]: fields for fields in (line.split(":") for line in lines)}
    assert {name: int(users[name][2]) for name in NUMERIC_IDS} == NUMERIC_IDS
    assert {users[name][6] for name in NUMERIC_IDS} == {"/usr/sbin/nologin"}


def test_each_file_that_a_verb_reads_beside_the_program_is_there(
    contents: list[tuple[str, tarfile.TarInfo, bool]], site: Site
) -> None:
    """All but the nodes of `rosrv demo`, which has a container of its own, and what a release adds to the image."""
    sources = "".join(path.read_text() for path in (ROOT / "appliance").rglob("*.py"))
    folders = set(re.findall(r'SHIPPED / "(\w+)"', sources)) - {"examples"}
    assert {"policies", "monitors"} <= folders
    listed = subprocess.run(
        ["git", "-c", f"safe.directory={ROOT}", "ls-files", *folders],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout.split()  # fmt: skip
    found = {path for path, _, _ in contents}
    assert [path for path in listed if f"/opt/rosrv/share/rosrv/{path}" not in found] == []
    presets = run(site, "rosrv", "guard", "list")
    files = (ROOT / "monitors" / "guards").glob("*.rv")
    names = {path.stem for path in files} - {"driver_check"}  # that of a driver, which `guard new` adds
    assert [name for name in names if f"\n{name}: " not in f"\n{presets}"] == []


def test_the_configuration_of_the_image_is_right(site: Site) -> None:
    shown = run(site, "rosrv", "config", "show")
    assert "isolation: container" in shown
    run(site, "rosrv", "config", "check", "/etc/rosrv/appliance.yaml")


def test_the_demonstration_contains_no_part_of_the_appliance(site: Site) -> None:
    assert run(site, "find", "/opt", "/usr", "-name", "appliance*", image=DEMO) == ""
    assert "rospy" in run(site, "/usr/bin/python3", "-c", "import rospy; print(rospy.__name__)", image=DEMO)
    assert run(site, "find", "/opt", "/usr", "-name", "rospy") == ""


def test_the_image_stays_small(site: Site) -> None:
    whole, base = (int(site.engine.inspect(name)["Size"]) for name in (APPLIANCE, BASE))
    assert whole - base < MAX_MEGABYTES * 1e6


def test_the_machines_own_network_is_refused(site: Site) -> None:
    rights = (
        "--cap-drop",
        "ALL",
        *(f"--cap-add={name}" for name in ("NET_ADMIN", "SETUID", "SETGID", "CHOWN")),
    )
    done = site.engine.docker("run", "--rm", "--network", "host", *rights, APPLIANCE, check=False)
    assert done.returncode == 1
    assert "this container shares the machine's network" in done.stderr
    assert "compose.host.yaml" in done.stderr

    def rules() -> str:
        return subprocess.run(["nft", "list", "tables"], capture_output=True, text=True, check=True).stdout

    assert "rosrv" not in site.machine.run(rules)


def test_too_few_rights_are_named(site: Site) -> None:
    done = site.engine.docker("run", "--rm", APPLIANCE, check=False, timeout=60)
    assert done.returncode == 1
    assert "NET_ADMIN" in done.stderr
