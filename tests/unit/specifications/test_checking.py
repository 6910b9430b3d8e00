from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from appliance.channel.messages import PartNames
from appliance.specifications.checking import contents, contents_at_start, parts
from appliance.specifications.specification_files import SpecificationsRefusedError, read_folder
from rosmop.fast import batch_codegen, build
from rosmop.fast.wasm_instance import WasmError
from rosmop.form.compiled import Compiled
from tests.support.examples import sample

TWIST = "event e(double v) /cmd_vel geometry_msgs/Twist '{linear.x:v}'"
GOOD = f"good() {{ double last = 0; {TWIST} {{ last = v; }} }}"
WRONG = f"wrong() {{ {TWIST} {{ v = missing; }} event t() every 1s {{ }} }}"
USER = f"begin user() {{ {TWIST} {{ v = last; }} }}"


def unbuilt(**files: str) -> dict[str, str]:
    return contents_at_start({f"{name}.rv": text for name, text in files.items()}, {}).unbuilt


def test_a_start_leaves_out_only_the_files_with_errors() -> None:
    found = contents_at_start(
        {"a.rv": USER, "b.rv": WRONG, "c.rv": GOOD, "d.rv": WRONG.replace("wrong", "d")}, {}
    )
    assert {name: text.split(": ")[0] for name, text in found.unbuilt.items()} == {
        "wrong": "b.rv:1:79", "d": "d.rv:1:75"
    }  # fmt: skip
    assert list(found.monitors) == ["user", "wrong", "good", "d"]
    assert found.topics["wrong"] == {"/cmd_vel"}


def test_a_load_is_refused_that_would_hold_up_messages_with_init() -> None:
    busy = "init() {{ for (int i = 0; i < {}; i++) n += i; }}"
    first, second = (
        {f"{name}.rv": f"{name}() {{ int n = 0; {busy.format(count)} {TWIST} {{ }} }}"}
        for name, count in (("a", 90_000), ("b", 110_000))
    )
    assert contents(first, {}).monitors and contents(second, {}).monitors
    with pytest.raises(SpecificationsRefusedError, match=r"^b\.rv:1:1: error: the first values and `init`"):
        contents(first | second, {})
    assert not contents_at_start(first | second, {}).unbuilt  # they may have been in force


def test_a_file_is_left_out_with_the_file_whose_variables_it_uses() -> None:
    assert set(unbuilt(a=USER, b=GOOD.replace("last = v", "last = x"))) == {"good", "user"}


def test_nothing_is_left_out_without_an_error() -> None:
    files = {"a.rv": GOOD, "b.rv": USER}
    assert contents_at_start(files, {}) == contents(files, {})


MONITORS = Path(__file__).parents[3] / "monitors"
SHIPPED = sorted(MONITORS.rglob("*.rv"))
WARNED = f"warned() {{ {TWIST} {{ if (v > 1) {{ v = 1; }} }} }}"


@pytest.mark.parametrize("text", [WARNED, *map(Path.read_text, sample(SHIPPED, 4))])
def test_without_lints_only_the_warnings_are_missing(text: str) -> None:
    files, definitions = {"a.rv": text}, read_folder(MONITORS).definitions
    found = contents(files, definitions)
    assert contents_at_start(files, definitions, lints=False) == msgspec.structs.replace(found, warnings=())
    assert any("NaN passes" in warning for warning in found.warnings) or text != WARNED


def test_errors_are_found_without_lints() -> None:
    with pytest.raises(SpecificationsRefusedError, match=r"a\.rv:1:.* error: .*missing"):
        contents({"a.rv": WRONG}, {}, lints=False)
    assert set(contents_at_start({"a.rv": WRONG}, {}, lints=False).unbuilt) == {"wrong"}


@pytest.mark.parametrize("text", ["wrong() {", "wrong() { event e() /x nobody/Knows '{}' { } }"])
@pytest.mark.parametrize("others", [{}, {"b.rv": WRONG}, {"b.rv": WRONG, "c.rv": GOOD, "d.rv": USER}])
def test_a_file_whose_topics_are_unknown_is_left_out_at_a_start(text: str, others: dict[str, str]) -> None:
    found = contents_at_start({"a.rv": text} | others, {})
    assert [error.partition(":")[0] for error in found.left_out.values()] == ["a.rv"]
    assert len(found.unbuilt) == bool(others)
    assert set(found.monitors.values()) == others.keys()


def test_a_definition_that_cannot_be_read_leaves_out_all_files() -> None:
    found = contents_at_start({"a.rv": GOOD}, {"own/Own.msg": "int32 int32 x\n"})
    assert (found.monitors, list(found.left_out)) == ({}, ["a.rv"])


def test_a_defect_of_the_compiler_leaves_out_one_file(monkeypatch: pytest.MonkeyPatch) -> None:
    written = batch_codegen.written_of

    def broken(compiled: Compiled) -> object:
        if any(one.name == "wrong" and one.variables for one in compiled.specifications):
            raise KeyError("f64")
        return written(compiled)

    monkeypatch.setattr(build, "written_of", broken)
    files = {"a": GOOD, "b": f"wrong() {{ int n; {TWIST} {{ n = 1; }} }}"}
    assert unbuilt(**files) == {"wrong": "a defect of rosrv, please report it: KeyError: 'f64'"}


def test_an_invalid_module_is_an_error_of_its_specification(monkeypatch: pytest.MonkeyPatch) -> None:
    data = contents({"a.rv": GOOD, "b.rv": WRONG.replace("missing", "2")}, {}).compiled
    monkeypatch.setattr(build, "check_steps", rejecting("wrong"))
    with pytest.raises(
        SpecificationsRefusedError, match=r"^b.rv:1:1: error: the code of wrong cannot be run: type"
    ):
        parts(data, [PartNames(("good", "wrong"), ())])


def rejecting(name: str) -> Callable[[Compiled, object], int]:
    def check_steps(compiled: Compiled, _module: object) -> int:
        if any(specification.name == name for specification in compiled.specifications):
            raise WasmError("type mismatch")
        return 0

    return check_steps
