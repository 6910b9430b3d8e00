"""A client generated from the contract, as an integrator makes one: every operation is in it, and it reads answers.

The generator lives in an environment of its own (`generated-client.lock`): its dependencies are not ours.
"""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.appliance import Appliance

LOCK = Path(__file__).with_name("generated-client.lock")
UV = Path(sys.executable).with_name("uv")
USE = """
import importlib, json, pkgutil, sys
sys.path.insert(0, sys.argv[1])
import client, client.api
for module in pkgutil.walk_packages(client.__path__, "client."):
    importlib.import_module(module.name)
from client import AuthenticatedClient
from client.api.graph import graph
from client.api.monitors import monitors
from client.api.policy import policy
from client.api.status import status
url, certificate, token = sys.argv[2:5]
with AuthenticatedClient(base_url=url, token=token, verify_ssl=certificate or True) as asking:
    answers = [one.sync(client=asking) for one in (status, policy, graph, monitors)]
print(json.dumps([type(one).__name__ for one in answers] + [answers[1].revision]))
"""


@pytest.fixture(scope="module")
def generator(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the programs of an environment with the generator."""
    place = tmp_path_factory.mktemp("generator") / "venv"
    for command in (["venv", str(place)], ["pip", "sync", "--python", str(place / "bin/python"), str(LOCK)]):
        subprocess.run([UV, "--quiet", *command], check=True, timeout=240)
    return place / "bin"


@pytest.fixture(scope="module")
def appliance() -> Iterator[Appliance]:
    """An appliance with REST."""
    with Appliance(options=("--api", "127.0.0.1:0")) as appliance:
        yield appliance


def test_every_operation_can_be_generated_and_read(
    generator: Path, appliance: Appliance, tmp_path: Path
) -> None:
    """Nothing is left out but bodies that are no JSON; the appliance's answers are read into the client's types."""
    contract = appliance.rest().get("/v1/openapi.json").json
    operations = [one for path in contract["paths"].values() for one in path.values()]
    assert not [name for name in contract["components"]["schemas"] if "." in name], "no module's name leaks"
    (tmp_path / "openapi.json").write_text(json.dumps(contract))
    made = subprocess.run(
        [generator / "openapi-python-client", "generate", "--path", "openapi.json", "--output-path", "client",
         "--meta", "none"],
        cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert made.returncode == 0, made.stdout + made.stderr
    assert "Unable to parse" not in made.stdout
    files = [file for file in (tmp_path / "client" / "api").rglob("*.py") if file.name != "__init__.py"]
    assert len(files) == len(operations)
    rest = appliance.rest()
    arguments = [str(tmp_path), rest.url.geturl(), str(rest.certificate or ""), str(appliance.ready["token"])]
    used = subprocess.run(
        [generator / "python", "-c", USE, *arguments], capture_output=True, text=True, timeout=60, check=False
    )
    assert used.returncode == 0, used.stderr
    assert json.loads(used.stdout) == ["Status", "PolicyInForce", "Graph", "Monitors", 1]
