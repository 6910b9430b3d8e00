import tempfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosrv_fleet.enrolment import EnrolmentError
from rosrv_fleet.robots import Robots

from appliance.signing.own_certificate import make_own_certificate
from fleet.tests.support.enrolled_robots import JoiningAppliance


def test_a_standby_joins_as_the_same_robot(tmp_path: Path) -> None:
    robots, first, second, third = (
        Robots(tmp_path / "robots"),
        JoiningAppliance(),
        JoiningAppliance(),
        JoiningAppliance(),
    )
    first.join(robots)
    with pytest.raises(EnrolmentError, match="robot invite arm7 --appliance NAME"):
        second.join(robots)
    robot = second.join(robots, "b")
    assert robot.public_keys == {first.raw, second.raw}
    assert (first.of(robots), second.of(robots)) == ("arm7/a", "arm7/b")
    second.certificate = make_own_certificate("arm7", 1)[1]
    second.join(robots, "b")
    assert (first.of(robots), second.of(Robots(tmp_path / "robots"))) == ("arm7/a", "arm7/b")
    for appliance in ("b", "c"):
        with pytest.raises(EnrolmentError, match="--appliance NAME"):
            third.join(robots, appliance)
    with pytest.raises(EnrolmentError, match="arm7 has this log key"):
        robots.add("arm8", second.key, make_own_certificate("arm8", 1)[1])


@pytest.mark.parametrize("gone", ["a", "b"])
def test_an_appliance_is_replaced(gone: str, tmp_path: Path) -> None:
    robots, machines, new = (
        Robots(tmp_path / "robots"),
        {"a": JoiningAppliance(), "b": JoiningAppliance()},
        JoiningAppliance(),
    )
    machines["b"].join(robots, "b")
    machines["a"].join(robots)
    robots.remove("arm7", gone)
    stays = "b" if gone == "a" else "a"
    assert (machines[gone].of(robots), machines[stays].of(robots)) == ("", f"arm7/{stays}")
    with pytest.raises(EnrolmentError, match="is not one of two appliances"):
        robots.remove("arm7", stays)
    with pytest.raises(EnrolmentError, match="was removed"):
        machines[gone].join(robots)
    robot = new.join(robots, "c")
    assert new.of(robots) == "arm7/c"
    assert robot.public_keys == {new.raw, *(machine.raw for machine in machines.values())}
    robots.remove("arm7")
    assert (new.of(robots), machines[stays].of(robots)) == ("", "")


acts = st.lists(
    st.tuples(st.sampled_from(["join", "join", "remove", "remove one"]), st.sampled_from("abc")), max_size=9
)


@given(acts)
def test_an_appliance_may_connect_only_if_its_last_act_is_a_join(steps: list[tuple[str, str]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        robots, machines = Robots(Path(folder) / "robots"), {name: JoiningAppliance() for name in "abc"}
        joined, removed, known = set[str](), set[str](), set[str]()
        for act, name in steps:
            try:
                if act == "join":
                    machines[name].certificate = make_own_certificate("arm7", 1)[1]
                    machines[name].join(robots, name)
                    joined.add(name)
                    known.add(name)
                else:
                    robots.remove("arm7", name if act == "remove one" else "")
                    joined = joined - {name} if act == "remove one" else set()
                    removed |= {name} if act == "remove one" else set()
            except EnrolmentError:
                full = len(joined) == 2 and name not in joined
                assert act != "join" or full or name in removed
                assert act != "remove" or not known
            for one, machine in machines.items():
                expected = f"arm7/{one}" if one in joined else ""
                if act != "join" or one != name or one in joined:
                    assert machine.of(robots) == machine.of(Robots(robots.folder)) == expected
