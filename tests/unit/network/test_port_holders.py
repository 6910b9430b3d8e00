import pytest

from appliance.network.port_holders import PortHolder


@pytest.mark.parametrize(
    ("command", "unit", "shown"),
    [
        (
            ("/usr/bin/python3", "/usr/bin/rosmaster", "--core"),
            "roscore.service",
            "/usr/bin/rosmaster (roscore.service)",
        ),
        (("/opt/vendor/master", "-p"), "session-1.scope", "/opt/vendor/master (session-1.scope)"),
        (("python3", "-m", "http.server"), "", "python3 (process 7)"),
        ((), "", "? (process 7)"),
        (("/bin/\x1b[2Jevil",), "a\nb.service", "/bin/?[2Jevil (a?b.service)"),
    ],
)
def test_a_holder_is_called_by_its_program_and_unit(command: tuple[str, ...], unit: str, shown: str) -> None:
    assert str(PortHolder(7, command, unit)) == shown


def test_a_name_that_its_process_chose_is_bounded() -> None:
    assert len(str(PortHolder(7, ("x" * 4096,), "y" * 4096))) < 300
