import pytest

from appliance.control.assembly.active_role import ActiveRole
from appliance.features.doors.orders import missing_port


def role(*ports: range) -> ActiveRole:
    made = ActiveRole()
    made.address, made.ports = "192.0.2.100", ports or None
    return made


@pytest.mark.parametrize(
    ("port", "ports", "warns"),
    [
        (9091, (), False),
        (None, (range(11311, 11312),), False),
        (9091, (range(11311, 11312), range(9090, 9100)), False),
        (9100, (range(11311, 11312), range(9090, 9100)), True),
        (9091, (range(11311, 11312),), True),
    ],
)
def test_a_port_that_the_fixed_address_of_a_pair_lacks_is_named(
    port: int | None, ports: tuple[range, ...], warns: bool
) -> None:
    warning = missing_port(port, role(*ports))
    assert bool(warning) is warns
    if warns:
        assert f"port {port} does not exist at 192.0.2.100" in warning
        assert "11311" in warning and "rosrv standby join" in warning
