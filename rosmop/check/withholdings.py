"""Check the topics that a specification withholds from hosts while one of its variables is true."""

from collections.abc import Iterator
from ipaddress import ip_network

from rosmop.check.scope import CompilationContext, SpecificationNames
from rosmop.check.statements import check_topic
from rosmop.form.compiled import Withholding
from rosmop.form.findings import SpecificationError
from rosmop.text import tree
from rosmop.types import value_types
from rosmop.types.messages import quote


def withholdings(
    shared: CompilationContext, names: SpecificationNames, specification: tree.Specification
) -> tuple[Withholding, ...]:
    found = []
    for node in specification.withholds:
        try:
            found.append(_check(names, specification, node))
        except SpecificationError as error:
            shared.findings += error.findings
    return tuple(found)


def _check(
    names: SpecificationNames, specification: tree.Specification, node: tree.WithholdDeclaration
) -> Withholding:
    check_topic(node.topic, node.position)
    if not any(
        isinstance(event.trigger, tree.MessageTrigger)
        and event.trigger.topic == node.topic
        and event.trigger.part is None
        for event in specification.events
    ):
        text = f"no event of {names.name} is on {node.topic}, so {names.name} cannot withhold it"
        raise SpecificationError.at(
            node.position, f"{text}; write `event name() {node.topic} package/Type '{{}}' {{ }}`"
        )
    if names.parameters:
        text = (
            "each slice would withhold it on its own; withhold a topic in a specification without parameters"
        )
        raise SpecificationError.at(node.position, text)
    condition = node.condition.parts[0]
    variable = names.variables.get(condition)
    if variable is None or not isinstance(variable.type, value_types.BoolType) or variable.constant:
        text = f"{quote(condition)} is not a `bool` variable of {names.name}"
        raise SpecificationError.at(node.condition.position, f"{text}; declare `bool {condition} = true;`")
    variable.used = True
    return Withholding(node.topic, tuple(_networks(node)), variable.code)


def _networks(node: tree.WithholdDeclaration) -> Iterator[str]:
    yield from node.given
    for network in node.networks:
        assert isinstance(network, tree.StringLiteral)  # a name of hosts is resolved already
        text = network.value.decode(errors="replace")
        try:
            yield str(ip_network(text))
        except ValueError as error:
            raise SpecificationError.at(
                network.position, f"{error}; give an address or a network, such as 10.0.0.7 or 10.8.0.0/16"
            ) from error
