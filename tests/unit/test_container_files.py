import re
import tarfile
from pathlib import Path

import yaml

from appliance.configuration.config_sources import resolve
from appliance.network.close_ports import RANGE_FILE
from appliance.supervisor.privileges import SUPERVISOR_CAPABILITIES
from appliance.supervisor.roles import ROLES
from appliance.supervisor.users import NUMERIC_IDS
from distribution.site import BESIDE, pack
from tests.support.docker import project_beside

ROOT = Path(__file__).parents[2]
TRUE = Path("/bin/true")


def granted() -> set[str]:
    return set(yaml.safe_load((ROOT / "compose.yaml").read_text())["services"]["appliance"]["cap_add"])


def test_the_image_has_every_user() -> None:
    made = re.findall(r"\b(ros[a-z-]+):(610\d\d)\b", (ROOT / "Dockerfile").read_text())
    assert {name: int(number) for name, number in made} == NUMERIC_IDS


def test_the_archive_of_a_site_has_what_its_compose_files_mount() -> None:
    for name in ("compose.yaml", "compose.host.yaml", "compose.local.yaml"):
        assert name in BESIDE
        services = yaml.safe_load((ROOT / name).read_text())["services"].values()
        mounts = [mount.split(":")[0] for service in services for mount in service.get("volumes", [])]
        beside = {mount.removeprefix("./") for mount in mounts if mount.startswith(".")}
        assert beside <= set(BESIDE), name
        assert not any("env_file" in service or "secrets" in service for service in services), name


def test_the_next_archive_of_a_site_uses_the_same_volume(tmp_path: Path) -> None:
    """Compose names a volume after its project, by default the folder: this has the version."""
    image = tmp_path / "rosrv-image_1_amd64.tar"
    image.touch()
    with tarfile.open(pack((image,), moment=0)) as archive:
        (name,) = [name for name in archive.getnames() if name.endswith("/.env")]
        content = archive.extractfile(name)
        assert content is not None
        assert b"COMPOSE_PROJECT_NAME=rosrv\n" in content.readlines()


def test_the_local_master_is_for_this_machine_only() -> None:
    local = yaml.safe_load((ROOT / "compose.local.yaml").read_text())
    assert local == {"services": {"appliance": {"ports": ["127.0.0.1:11311:11311"]}}}


def test_each_appliance_has_a_name() -> None:
    named = {"compose.yaml": ["appliance"], "compose.standby.yaml": ["a", "b"]}
    for file, services in named.items():
        made = yaml.safe_load((ROOT / file).read_text())["services"]
        assert all(made[service]["hostname"].startswith("rosrv") for service in services)


def test_every_process_is_in_the_table_of_processes() -> None:
    text = (ROOT / "docs" / "reference" / "processes.md").read_text()
    rows = re.findall(r"^\| `([a-z]+)` \| `([a-z-]+)` \| ([^|]*) \|", text, re.MULTILINE)
    documented = {name: (user, set(re.findall(r"[A-Z][A-Z_]+", rights))) for name, user, rights in rows}
    expected = {role.name: (role.user, set(role.capabilities)) for role in ROLES}
    assert documented == expected | {"supervisor": ("root", granted())}
    [beyond] = re.findall(
        r"^Outside the container, the supervisor also has ([A-Z_ ]+)\.$", text, re.MULTILINE
    )
    assert set(beyond.split()) == set(SUPERVISOR_CAPABILITIES) - granted()


def test_the_container_is_given_what_the_supervisor_knows() -> None:
    assert granted() <= set(SUPERVISOR_CAPABILITIES)


def test_each_right_has_its_reason_beside_it() -> None:
    lines = [
        line for line in (ROOT / "compose.yaml").read_text().splitlines() if re.match(r" +- [A-Z_]+\b", line)
    ]
    assert len(lines) == len(granted())
    assert all(re.search(r"  # \w", line) for line in lines)


def environment(**outside: str) -> dict[str, str]:
    told = yaml.safe_load((ROOT / "compose.yaml").read_text())["services"]["appliance"]["environment"]
    return {
        key: re.sub(r"\$\{(\w+):-(.*?)\}", lambda found: outside.get(found[1], found[2]), value)
        for key, value in told.items()
    }


def test_the_endpoint_is_one_line_in_env() -> None:
    assert resolve(None, environment(), {}).ipsec.endpoint is None
    assert resolve(None, environment(ROSRV_ENDPOINT="192.168.1.20"), {}).ipsec.endpoint == "192.168.1.20"


def test_a_flood_ends_in_the_container() -> None:
    appliance = yaml.safe_load((ROOT / "compose.yaml").read_text())["services"]["appliance"]
    assert appliance["mem_limit"] == appliance["memswap_limit"] == "2g"
    assert 100 <= appliance["pids_limit"] <= 1000
    settings = resolve(None, environment(), {})
    others = 500 << 20  # docs/reference/processes.md
    assert 4 * settings.relay.memory_bytes + others < 2 << 30


def test_the_container_closes_the_ports_of_its_machine() -> None:
    """A container has its own local port range, whatever the range of its machine is."""
    texts = [path.read_text() for path in ((ROOT / "compose.host.yaml"), *(ROOT / "docs").rglob("*.md"))]
    command = r"exec -T appliance rosrv protect (.*?)nft -f -"
    options = [found for text in texts for found in re.findall(command, text, re.DOTALL)]
    assert len(options) >= 2
    assert all('--ports "$(' in found and f"< {RANGE_FILE})" in found for found in options), options


def test_a_later_command_of_the_pages_keeps_the_files_of_the_robot(tmp_path: Path) -> None:
    """`-f` would hold for one command only, so the next `up` would start the appliance with another policy."""
    files = re.search(r"COMPOSE_FILE=(\S+)", (project_beside(tmp_path) / ".env").read_text())
    assert files is not None
    assert all((ROOT / file).is_file() for file in files[1].split(":"))
    texts = {path: path.read_text() for path in (*ROOT.glob("compose*.yaml"), *(ROOT / "docs").rglob("*.md"))}
    for path, text in texts.items():
        for options in re.findall(r"docker[ -]compose ((?:-f|--file) .*)", text):
            assert re.match(r"(-f compose\.standby|--file fleet/compose)\.yaml ", options), (path, options)
