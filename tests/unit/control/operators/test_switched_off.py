from collections.abc import Callable
from pathlib import Path

import pytest

from appliance.control.operators.switched_off import SwitchedOffWatch
from appliance.policy.policy_compiler import compile_policy
from appliance.specifications.switches import SHADOW, Switch
from tests.support.core import Core

AUDIT_ONLY = "[Options]\naudit-only = publishers, subscribers\n"


def watch(
    core: Core,
    off: dict[str, Switch],
    *,
    until: Callable[[str], float | None] = lambda _name: None,
    policy: str = "",
    forgotten_after: float | None = 3600.0,
) -> SwitchedOffWatch:
    compiled = compile_policy(policy, file="p.ini")
    return SwitchedOffWatch(
        lambda: off, until, lambda: compiled,
        store=core.store, trail=core.trail, forgotten_after=forgotten_after,
    )  # fmt: skip


def recorded(core: Core) -> list[str]:
    return [f"{record.event}: {record.reason}" for record in core.trail.records]


@pytest.mark.nightly
@pytest.mark.anyio
async def test_a_disabled_monitor_is_an_alarm_once(tmp_path: Path) -> None:
    core, off = Core(tmp_path), dict[str, Switch](a=False, b=SHADOW)
    looks = watch(core, off)
    looks.look(3000.0)
    assert [row.forgotten for row in looks.rows()] == [False, False]
    await core.store.until_settled()
    looks = watch(core, off)
    looks.look(700.0)
    assert recorded(core) == [
        "protection forgotten: monitor a is disabled for more than 1.0 h: rosrv monitor enable a",
        "protection forgotten: monitor b is in shadow mode for more than 1.0 h: rosrv monitor enforce b",
    ]
    await core.store.until_settled()
    looks = watch(core, off)
    looks.look(9000.0)
    assert len(recorded(core)) == 2
    assert [row.forgotten for row in looks.rows()] == [True, True]
    off.clear()
    looks.look(60.0)
    off["a"] = False
    looks.look(60.0)
    assert [row.forgotten for row in looks.rows()] == [False]
    core.store.close()


def test_a_timed_change_is_not_forgotten(tmp_path: Path) -> None:
    core, off, until = Core(tmp_path), dict[str, Switch](a=False), {"a": 1e12}
    looks = watch(core, off, until=until.get)
    looks.look(9000.0)
    assert recorded(core) == []
    until["a"] = 1.0
    looks.look(9000.0)
    assert len(recorded(core)) == 1
    core.store.close()


def test_an_audit_only_section_is_forgotten_like_a_monitor(tmp_path: Path) -> None:
    core = Core(tmp_path)
    looks = watch(core, {}, policy=AUDIT_ONLY, forgotten_after=None)
    looks.look(1e9)
    assert [(row.about, row.name, row.forgotten) for row in looks.rows()] == [
        ("policy", "Publishers", False),
        ("policy", "Subscribers", False),
    ]
    assert recorded(core) == []
    watch(core, {}, policy=AUDIT_ONLY).look(3600.0)
    assert len(recorded(core)) == 2
    core.store.close()
