import hashlib
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rosmop.check.sources import compiled_from
from rosmop.fast.build import part_of
from rosmop.fast.serialization import decoded_part, encoded_part
from rosmop.fast.wasm_instance import WasmError
from rosmop.fast.wasm_runner import WasmFastPath
from rosmop.form.compiled import Compiled
from rosmop.form.findings import SpecificationError
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import Outcome
from rosmop.tests.examples import examples
from rosmop.tests.random_specifications import Messages, Specifications, definitions

FEW = settings(max_examples=examples(60), suppress_health_check=list(HealthCheck))
RULE = """
{0}() {{ int count = 0; std::string last = "";
    event e(std::string text) /{0} std_msgs/String '{{data:text}}' {{
        if (text == last) {{ count++; ROS_WARN("%d: %s", count, text.c_str()); }} last = text;
        PUBLISH(/said/{0}, std_msgs/Int32, said); said.data = 100 / (3 - count); }}
    std_msgs::Int32 said;
    fsm : idle [ e -> idle ]
    @idle {{ count += 0; }}
}}"""
PROGRAM = """
import hashlib, sys
from rosmop.fast.build import part_of
from rosmop.fast.serialization import encoded_part
from rosmop.tests.test_modules import compiled
print(hashlib.sha256(encoded_part(part_of(compiled("b", "a"), ["a"], []))).hexdigest())
"""


def rule(name: str) -> str:
    head, _, rest = RULE.format(name).partition("event")
    body, _, said = rest.partition("    std_msgs::Int32 said;\n")
    return f"{head}std_msgs::Int32 said; event{body}{said}"


def compiled(*names: str) -> Compiled:
    return compiled_from({f"{name}.rv": rule(name) for name in names}, definitions())


def story(outcome: Outcome, names: set[str]) -> Iterator[object]:
    for earlier in outcome.before:
        yield from story(earlier, names)
    yield [event for event in outcome.events if event.partition(".")[0] in names]
    yield [verdict for verdict in outcome.verdicts if verdict.monitor in names]
    yield [(fault.position, fault.text, fault.values) for fault in outcome.faults if fault.monitor in names]
    yield [one for one in outcome.log if one.monitor in names]
    yield [
        (one._replace(site=0), outcome.sites[one.site].position)
        for one in outcome.published
        if one.monitor in names
    ]


def test_a_part_is_the_same_whatever_else_is_in_the_set() -> None:
    """A relay gets nothing new when other specifications change."""
    alone = encoded_part(part_of(compiled("a"), ["a"], []))
    assert encoded_part(part_of(compiled("a", "b", "c"), ["a"], [])) == alone
    assert encoded_part(part_of(compiled("c", "b", "a"), ["a"], [])) == alone
    assert encoded_part(part_of(compiled("a", "b"), ["b"], [])) != alone
    assert encoded_part(part_of(compiled("a"), ["a"], ["a"])) != alone


@pytest.mark.nightly
def test_another_process_makes_the_same_module() -> None:
    hashes = {
        subprocess.run(
            [sys.executable, "-c", PROGRAM],
            env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True, text=True, check=True,
        ).stdout
        for seed in "123"
    }  # fmt: skip
    part = encoded_part(part_of(compiled("b", "a"), ["a"], []))
    assert hashes == {hashlib.sha256(part).hexdigest() + "\n"}


@FEW
@given(seed=st.integers(0, 1 << 30))
def test_it_does_what_its_specifications_do_in_the_set(seed: int) -> None:
    texts = {f"{place}.rv": text for place, text in enumerate(Specifications(seed).texts())}
    try:
        whole = compiled_from(texts, definitions())
    except SpecificationError:
        return  # the random text is not a valid specification
    for names in whole.groups([specification.name for specification in whole.specifications]):
        part = encoded_part(part_of(whole, names, ()))
        sent = decoded_part(part)
        assert encoded_part(sent) == part
        own = MonitorSet.of(sent.compiled, fast=WasmFastPath(sent.module))
        among = MonitorSet.of(whole.part(names))
        stories = [[*story(one.start(0), names)] for one in (own, among)]
        messages, time = Messages(seed), 0
        for traffic in (messages.traffic() for _ in range(4)):
            for body in traffic.bodies():
                time += 400_000
                for told, one in zip(stories, (own, among), strict=True):
                    outcome = one.process(traffic.topic, bytearray(body), time)
                    told += [outcome.result, bytes(outcome.buffer), *story(outcome, names)]
        assert stories[0] == stories[1]


def test_only_what_is_not_in_shadow_mode_has_a_module() -> None:
    part = part_of(compiled("a", "b"), ["a", "b"], ["b"])
    assert list(part.module.feeds) == ["/a"]
    assert {specification.name for specification in part.compiled.specifications} == {"a", "b"}


@pytest.mark.parametrize("wrong", [b"", b"\x7fELF", b"\0asm\1\0\0\0"])
def test_foreign_machine_code_is_refused(wrong: bytes) -> None:
    part = part_of(compiled("a"), ["a"], [])
    with pytest.raises(WasmError):
        MonitorSet.of(part.compiled, fast=WasmFastPath(replace(part.module, code=wrong)))


@pytest.mark.parametrize("length", [0, 1, 100])
def test_a_part_that_is_cut(length: int) -> None:
    with pytest.raises(msgspec.MsgspecError):
        decoded_part(encoded_part(part_of(compiled("a"), ["a"], []))[:length])
