import pytest

from appliance.channel.messages import PartNames
from appliance.specifications.checking import check, parts
from appliance.specifications.specification_files import Sources, SpecificationsRefusedError
from rosmop.check.sources import compiled_from
from rosmop.fast import batch_codegen
from rosmop.fast.serialization import encode
from rosmop.logics import catalogue
from rosmop.logics.automaton import Automaton
from rosmop.logics.interface import FiniteProperty, Logic, Source
from roswire.standard import standard_definitions

GUARD = """guard() {
    event a() /x std_msgs/Bool '{}' { }
    event b() /y std_msgs/Bool '{}' { }
    ltl: [](a => o (!a U b))
    @violation { ROS_WARN("no"); DROP; }
}"""


def test_a_wrong_automaton_loads_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def compile_wrong(source: Source) -> FiniteProperty:
        return FiniteProperty(source, ("violation", "validation"), Automaton(0, ((0, 0),), ((),)))

    assert check(Sources({"guard.rv": GUARD}), ()).monitors == {"guard": "guard.rv"}
    monkeypatch.setattr(catalogue, "LOGICS", {**catalogue.LOGICS, "ltl": Logic(compile_wrong)})
    with pytest.raises(SpecificationsRefusedError) as refused:
        check(Sources({"guard.rv": GUARD}), ())
    (finding,) = refused.value.findings
    assert finding.startswith(
        "guard.rv:4:10: error: the automaton of this property differs from its formula: "
    )
    assert "this is a defect of the monitor compiler" in finding


def test_no_relay_gets_a_wrong_module(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch_codegen.TopicCodegen, "_handle", lambda *_: b"")
    compiled = encode(compiled_from({"guard.rv": GUARD}, standard_definitions()))
    with pytest.raises(SpecificationsRefusedError, match="this is a defect of the monitor compiler"):
        parts(compiled, [PartNames(("guard",))])
