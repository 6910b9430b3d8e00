import http.client
import ssl
import subprocess
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.processes import LIMIT
from tests.support.requirements import need_root


@pytest.fixture
def lab() -> Iterator[Lab]:
    need_root()
    with Lab("rosrv-rest") as lab:
        yield lab


def status(certificate: str, address: str, port: int, timeout: float = LIMIT) -> str:
    connection = http.client.HTTPSConnection(
        address, port, timeout=timeout, context=ssl.create_default_context(cadata=certificate)
    )
    try:
        connection.request("GET", "/healthz")
        return str(connection.getresponse().status)
    except OSError as error:
        return type(error).__name__
    finally:
        connection.close()


def certificate_of(appliance: Appliance, host: Host, port: int) -> str:
    return host.run(partial(ssl.get_server_certificate, ("127.0.0.1", port), timeout=LIMIT))


def test_only_configured_networks_reach_it(lab: Lab, tmp_path: Path) -> None:
    machine = lab.host("machine", "10.82.0.2/24")
    manager, unknown = lab.host("manager", "10.82.0.10/24"), lab.host("unknown", "10.82.0.66/24")
    config = tmp_path / "appliance.yaml"
    config.write_text("api: 0.0.0.0:8443\napi_networks: [10.82.0.10/32]\n")
    options = ("--config", str(config), "--listen", "0.0.0.0:11311")
    with Appliance(machine, isolation="container", options=options) as appliance:
        assert appliance.master_uri == "http://10.82.0.2:11311", "without a default route, the only network"
        certificate = certificate_of(appliance, machine, 8443)
        assert machine.run(partial(status, certificate, "127.0.0.1", 8443)) == "200"
        assert unknown.run(partial(status, certificate, "10.82.0.2", 8443)) == "ConnectionRefusedError"
        # The certificate has only the machine's own names, so the manager sees a wrong name.
        assert manager.run(partial(status, certificate, "10.82.0.2", 8443)) == "SSLCertVerificationError"


def test_a_given_address_is_in_the_certificate(lab: Lab, tmp_path: Path) -> None:
    machine, manager = lab.host("machine", "10.82.0.2/24"), lab.host("manager", "10.82.0.10/24")
    config = tmp_path / "appliance.yaml"
    config.write_text("api_networks: [10.82.0.0/24]\n")
    options = ("--config", str(config), "--api", "10.82.0.2:8443")
    with Appliance(machine, isolation="container", options=options) as appliance:
        assert appliance.ready["api"] == "https://10.82.0.2:8443"
        served = manager.run(partial(ssl.get_server_certificate, ("10.82.0.2", 8443), timeout=LIMIT))
        assert manager.run(partial(status, served, "10.82.0.2", 8443)) == "200"


def test_in_a_namespace_of_its_own_the_machine_reaches_it(lab: Lab, tmp_path: Path) -> None:
    machine, unknown = lab.host("machine", "10.82.0.2/24"), lab.host("unknown", "10.82.0.66/24")
    with Appliance(machine, isolation="netns", options=("--api", "127.0.0.1:8443")) as appliance:
        assert appliance.ready["api"] == "https://127.0.0.1:8443"
        certificate = certificate_of(appliance, machine, 8443)
        assert machine.run(partial(status, certificate, "127.0.0.1", 8443)) == "200"
        assert unknown.run(partial(status, certificate, "10.82.0.2", 8443, timeout=5)) in (
            "ConnectionRefusedError", "TimeoutError",
        )  # fmt: skip


def test_a_port_in_use_is_an_error(lab: Lab) -> None:
    machine = lab.host("machine", "10.82.0.2/24")
    program = (
        "import socket; s = socket.create_server(('127.0.0.1', 8443)); print('here', flush=True); s.accept()"
    )
    other = machine.popen(["python3", "-c", program], stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout is not None
        other.stdout.readline()
        appliance = Appliance(machine, isolation="container", options=("--api", "127.0.0.1:8443"))
        try:
            with pytest.raises(AssertionError, match=r"port 8443 .* is in use") as error:
                appliance.start()
            assert "firewall" not in str(error.value), "it is not built anew for each try"
        finally:
            appliance.close()
        with Appliance(machine, isolation="container") as elsewhere:
            assert not elsewhere.ready["api"].endswith(":8443")
    finally:
        other.kill()
        other.communicate()
