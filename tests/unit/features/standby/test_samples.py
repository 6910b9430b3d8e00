import msgspec

from appliance.features.standby.answers import StandbyState
from appliance.features.standby.summary import UNCHECKED
from appliance.features.standby.view import samples_of
from tests.support.answers import example


def numbers(state: StandbyState) -> dict[str, float]:
    return {
        f'{name}{{role="{labels[0]}"}}' if labels else name: float(value)
        for name, samples in samples_of(state).items()
        for labels, value in samples
    }


def test_the_active_appliance_has_the_lag_of_the_standby() -> None:
    other = {
        "name": "b", "connected": True, "behind_changes": 12, "behind_bytes": 3400, "witness_seconds": 7.5,
    }  # fmt: skip
    state = example(
        StandbyState, name="a", role="active", epoch=4, other=other, obstacle="other keys",
        witness={"answered_seconds": 0.25, "holder": "b", "trouble": "full"},
    )  # fmt: skip
    assert {name.removeprefix("rosrv_standby_"): value for name, value in numbers(state).items()} == {
        'role{role="active"}': 1, 'role{role="standby"}': 0, "connected": 1, "in_sync": 0, "can_take_over": 1,
        "obstacle": 1, "behind_changes": 12, "behind_bytes": 3400, "witness_age_seconds": 0.25,
        "other_witness_age_seconds": 7.5, "witness_trouble": 1, "both_active": 1, "takeovers_total": 4,
    }  # fmt: skip


def test_a_standby_has_its_own_metrics() -> None:
    state = example(
        StandbyState, name="b", role="standby", epoch=4, other={"name": "a"}, obstacle=UNCHECKED,
        witness={"refusal": "the witness knows only epoch 3"}, troubles=[UNCHECKED],
    )  # fmt: skip
    assert {name.removeprefix("rosrv_standby_"): value for name, value in numbers(state).items()} == {
        'role{role="active"}': 0,
        'role{role="standby"}': 1,
        "connected": 0,
        "can_take_over": 0,
        "obstacle": 1,
        "witness_age_seconds": float("inf"),
        "witness_trouble": 1,
        "takeovers_total": 4,
    }
    assert samples_of(msgspec.structs.replace(state, epoch=0))["rosrv_standby_takeovers_total"] == []
