from appliance.features.guards.robot_graph import VELOCITIES
from appliance.relay.velocity_zero import LAYOUTS


def test_a_rank_knows_the_zeros_of_all_types_of_velocities() -> None:
    """A type that only the guards know would never let go."""
    assert LAYOUTS.keys() == {*VELOCITIES}
