"""Choose types and values: make the specifications of a file from its typed parts, its `preset` statement and roles.

The types of typed topics decide which rows of the roles (`types/roles.py`) the events get. Everything happens on the
tree, so positions and messages are those of the text.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple, TypeVar, cast

from rosmop.form.findings import Diagnostic, Position, SpecificationError
from rosmop.text import tree
from rosmop.types import given_lists
from rosmop.types.messages import nearest, quote
from roswire.names import is_global_name

_T = TypeVar("_T")
Roles = Mapping[str, tree.RoleDeclaration]
_GOAL_ID = "actionlib_msgs/GoalID"
_ALL_GOALS = "all_goals"
"""The variable with the message that cancels all goals of an action."""
_CANCEL = "cancel"


class _Chosen(NamedTuple):
    """A typed topic, with the type that it has here."""

    topic: str
    type: str
    role: tree.RoleDeclaration
    row: tree.RoleRow


def make_specifications(typed: tree.TypedFile, shipped: Callable[[], Roles]) -> tree.SpecificationFile:
    """Return the specifications with their types and values. Raises `SpecificationError` with all errors.

    `shipped()` returns the roles that each file has beside its own.
    """
    presets = {one.preset: one for one in typed.presets}
    findings = [*_unknown_presets(typed), *_repeated_roles(typed)]
    specifications = []
    for one in typed.specifications:
        preset = presets.get(one.known.name if isinstance(one, tree.TypedSpecification) else one.name)
        try:
            specifications.append(_Maker(typed, one, preset, shipped).specification())
        except SpecificationError as error:
            findings += error.findings
    if findings:
        raise SpecificationError(findings)
    return replace(typed.file, specifications=tuple(specifications))


def _unknown_presets(typed: tree.TypedFile) -> Iterable[Diagnostic]:
    names = [one.known.name if isinstance(one, tree.TypedSpecification) else one.name
             for one in typed.specifications]  # fmt: skip
    seen = set()
    for one in typed.presets:
        if one.preset not in names:
            text = f"this file has no specification {quote(one.preset)}{nearest(one.preset, names)}"
            yield Diagnostic(one.position, "error", text)
        if one.preset in seen:
            yield Diagnostic(
                one.position, "error", f"{quote(one.preset)} has a `preset` statement; leave this one out"
            )
        seen.add(one.preset)


def _repeated_roles(typed: tree.TypedFile) -> Iterable[Diagnostic]:
    seen = set()
    for role in typed.roles:
        if role.name in seen:
            yield Diagnostic(role.position, "error", f"there is another role {quote(role.name)} in this file")
        seen.add(role.name)


@dataclass
class _Maker:
    typed: tree.TypedFile
    written: tree.Specification | tree.TypedSpecification
    preset: tree.PresetStatement | None
    shipped: Callable[[], Roles]
    findings: list[Diagnostic] = field(default_factory=list)
    topics: dict[str, _Chosen] = field(default_factory=dict)
    tables: list[tree.Declaration] = field(default_factory=list)
    hosts: dict[str, tuple[str, ...]] = field(default_factory=dict)
    times: list[tuple[str, int]] = field(default_factory=list)

    def specification(self) -> tree.Specification:
        written, preset = self.written, self.preset
        known = written.known if isinstance(written, tree.TypedSpecification) else written
        settings: dict[str, tree.Setting] = {}
        for setting in preset.settings if preset else ():
            if setting.name in settings:
                self._refuse(setting.position, f"{quote(setting.name)} is set twice")
            settings[setting.name] = setting
        if isinstance(written, tree.TypedSpecification):
            self._check_names(written)
        givens = tuple(
            made
            for given in written.givens
            if (made := self._given(given, settings.get(given.name))) is not None
        )
        self._check_settings(settings, [given.name for given in written.givens])
        cancels, safes, events = set[str](), [], []
        for safe in written.safes:
            made_safe = self._safe(safe) if isinstance(safe, tree.TypedSafe) else safe
            if made_safe is None and isinstance(safe, tree.TypedSafe) and safe.topic in self.topics:
                cancels.add(safe.topic)
                if len(cancels) > 1:
                    text = "a specification cancels the goals of one action; write another one for this topic"
                    self._refuse(safe.position, text)
            elif made_safe is not None:
                safes.append(made_safe)
        events = [self._event(one) if isinstance(one, tree.TypedEvent) else one for one in written.events]
        if self.findings:
            raise SpecificationError(self.findings)
        result = replace(
            known,
            name=preset.name if preset else known.name,
            switch=preset.switch if preset else "",
            givens=givens,
            events=tuple(event for event in events if event is not None),
            safes=tuple(safes),
            withholds=tuple(map(self._withhold, known.withholds)),
            declarations=(*self.tables, *known.declarations),
            properties=tuple(replace(one, times=tuple(self.times)) for one in known.properties),
        )
        for topic in cancels:
            result = _cancelling(result, topic, self.topics[topic].topic)
        if self.findings:
            raise SpecificationError(self.findings)
        return _with_values_of_roles(result, self.topics.values())

    def _refuse(self, position: Position, text: str) -> None:
        self.findings.append(Diagnostic(position, "error", text))

    def _check_names(self, written: tree.TypedSpecification) -> None:
        seen = set()
        for given in written.givens:
            if given.name in seen:
                self._refuse(given.position, f"{quote(given.name)} is given twice")
            seen.add(given.name)

    def _check_settings(self, settings: Mapping[str, tree.Setting], names: list[str]) -> None:
        for name, setting in settings.items():
            if name not in names:
                self._refuse(setting.position, f"{quote(name)} is not given to it{nearest(name, names)}")

    # Givens

    def _given(
        self,
        node: tree.GivenValue | tree.TopicDeclaration | tree.TypedTopic | tree.GivenList,
        setting: tree.Setting | None,
    ) -> tree.GivenValue | tree.TopicDeclaration | None:
        place = setting.position if setting else node.position
        if isinstance(node, tree.TypedTopic):
            topic, _, kind = (setting.value if setting else node.topic).partition(" ")
            if setting is not None:
                self._check_topic(node.name, topic, place)
            self._choose(node, topic, kind, place)
            return tree.TopicDeclaration(node.position, node.name, topic)
        if isinstance(node, tree.GivenList):
            self._list(
                node,
                setting.value if setting else given_lists.without_unit(node.kind, node.default)[0],
                place,
            )
            return None
        if setting is None:
            return node
        if isinstance(node, tree.TopicDeclaration):
            self._check_topic(node.name, setting.value, place)
            return replace(node, topic=setting.value)
        return replace(node, position=place, default=self._constant(node, setting))

    def _check_topic(self, name: str, topic: str, position: Position) -> None:
        if not is_global_name(topic):
            only = ", without a type" if is_global_name(topic.partition(" ")[0]) else ""
            self._refuse(position, f"{quote(topic)} is not a topic; write it like {name} = /cmd_vel{only}")

    def _constant(self, node: tree.GivenValue, setting: tree.Setting) -> str:
        value = setting.value
        if node.type == ("bool",):
            if value not in ("true", "false"):
                self._refuse(
                    setting.position, f"{quote(value)}: write {node.name} = true or {node.name} = false"
                )
                return node.default
            return value
        try:
            return given_lists.number(value)
        except ValueError:
            unit = " without its unit" if node.unit else ""
            self._refuse(
                setting.position,
                f"{quote(value)}: write a number{unit}, such as {node.name} = {node.default}",
            )
            return node.default

    def _choose(self, node: tree.TypedTopic, topic: str, kind: str, position: Position) -> None:
        role = self._role(node.role, node.position)
        if role is None:
            return
        rows = {row.type: row for row in role.rows}
        kind = kind or next(iter(rows), "")
        if not kind:
            text = f"no type of {topic} is known; begin {role.name} with a row, such as `std_msgs/Bool '{{data:x}}';`"
            self._refuse(position, text)
            return
        row = rows.get(kind) or (rows.get("") if kind else None)
        if row is None:
            text = f"{topic} cannot have the type {quote(kind)}; {role.name} has {', '.join(rows)}"
            self._refuse(position, text)
            return
        self.topics[node.name] = _Chosen(topic, kind, role, row)

    def _role(self, name: str, place: Position) -> tree.RoleDeclaration | None:
        """Return a role with the values and rows of those that it extends."""
        roles = {**self.shipped(), **{role.name: role for role in self.typed.roles}}
        chain: list[tree.RoleDeclaration] = []
        while name:
            role = roles.get(name)
            if role is None or role in chain:
                why = "there is no role" if role is None else "there is a circle of roles with"
                self._refuse(place, f"{why} {quote(name)}{'' if role else nearest(name, roles)}")
                return None
            chain.insert(0, role)
            name, place = role.base, role.position
        parameters = tuple(parameter for role in chain for parameter in role.parameters)
        return replace(
            chain[-1], parameters=parameters, rows=tuple(row for role in chain for row in role.rows)
        )

    def _list(self, node: tree.GivenList, value: str, position: Position) -> None:
        name = node.name
        try:
            match node.kind:
                case "corners":
                    self._table(
                        node, "double", name, [n for corner in given_lists.corners(value) for n in corner]
                    )
                case "joints":
                    rows = given_lists.joints(value)
                    self._table(node, "", f"{name}_names", [row[0] for row in rows] or [""])
                    self._table(node, "double", f"{name}_low", [row[1] for row in rows] or ["0"])
                    self._table(node, "double", f"{name}_high", [row[2] for row in rows] or ["0"])
                case "entries":
                    found = given_lists.entries(value)
                    self._table(node, "", f"{name}_names", [row[0] for row in found])
                    self._table(node, "int", f"{name}_ways", [row[1] for row in found])
                case "hosts":
                    self.hosts[name] = given_lists.hosts(value)
                case _:
                    self.times.append((name, given_lists.nanoseconds(value)))
        except ValueError as error:
            why = f"{error}; " if str(error) else ""
            self._refuse(
                position, f"{quote(value)}: {why}write it like {name} = {given_lists.EXAMPLES[node.kind]}"
            )

    def _table(self, node: tree.GivenList, of: str, name: str, cells: Iterable[str]) -> None:
        at = node.position
        items = (tree.GivenItems if node.kind == "corners" else tree.InitializerList)(
            at, tuple(_number(at, cell) if of else _text(at, cell) for cell in cells)
        )
        kind = tree.TypeName(at, (of,) if of else ("std", "string"), constant=True)
        self.tables.append(tree.Declaration(at, kind, (tree.Declarator(at, name, items, is_array=True),)))

    def _withhold(self, node: tree.WithholdDeclaration) -> tree.WithholdDeclaration:
        names = [network for network in node.networks if isinstance(network, tree.Name)]
        if not names:
            return node
        networks = self.hosts.get(names[0].parts[0])
        if networks is None:
            self._refuse(names[0].position, f"no `hosts` {quote(names[0].parts[0])} are given to it")
            return node
        return replace(node, networks=(), given=networks)

    # Events and safe messages

    def _topic(self, name: str, place: Position) -> _Chosen | None:
        if name not in self.topics and not self.findings:
            self._refuse(
                place, f"{quote(name)} has no role here: write its type, or `topic {name} : Role = /topic;`"
            )
        return self.topics.get(name)

    def _safe(self, node: tree.TypedSafe) -> tree.SafeDeclaration | None:
        chosen = self._topic(node.topic, node.position)
        if chosen is None or chosen.row.cancels:
            return None
        return tree.SafeDeclaration(node.position, chosen.type, node.position, (), node.topic, node.period_ns)

    def _event(self, node: tree.TypedEvent) -> tree.EventDefinition | None:
        chosen = self._topic(node.topic, node.position)
        if chosen is None:
            return None
        row, role, at = chosen.row, chosen.role, node.position
        types = {parameter.name: parameter.type for parameter in role.parameters} | {
            parameter.name: parameter.type for parameter in row.parameters
        }
        names = [name.parts[0] for name in node.names]
        for one in node.names:
            if one.parts[0] not in types:
                known = nearest(one.parts[0], [parameter.name for parameter in role.parameters])
                self._refuse(one.position, f"{role.name} has no value {quote(one.parts[0])}{known}")
        if self.findings:
            return None
        bound = {one.variable or "": one for one in row.pattern}
        first: list[tree.Statement] = []
        if row.action is not None and names:
            parameters, pattern, first = row.parameters, row.pattern, [*row.action.statements]
        else:
            there = [name for name in names if name in bound]
            parameters = tuple(tree.ParameterDeclaration(at, types[name], name) for name in there)
            pattern = tuple(bound[name] for name in there)
            lacking = [name for name in names if name not in bound]
            doubles = [name for name in lacking if types[name].name == ("double",)]
            if doubles:
                zeros = tuple(tree.Declarator(at, name, tree.NumberLiteral(at, "0")) for name in doubles)
                first = [tree.Declaration(at, tree.TypeName(at, ("double",)), zeros)]
            first += [
                tree.Declaration(at, _of_variable(types[name]), (tree.Declarator(at, name),))
                for name in lacking
                if name not in doubles
            ]
        self._check_condition(node, chosen, {parameter.name for parameter in parameters})
        if self.findings:
            return None
        trigger = tree.MessageTrigger(at, node.topic, chosen.type, at, None, _move(pattern, at), node.when)
        action = replace(node.action, statements=(*_move(tuple(first), at), *node.action.statements))
        return tree.EventDefinition(at, node.modifiers, node.name, _move(parameters, at), trigger, action)

    def _check_condition(self, node: tree.TypedEvent, chosen: _Chosen, fields: Collection[str]) -> None:
        names = {name.parts[0] for name in node.names} - {*fields}
        for part in tree.walk(node.when):
            if isinstance(part, tree.Name) and part.parts[0] in names:
                text = f"{quote(part.parts[0])} is not a field of {chosen.type}: test it in the action, not in `when`"
                self._refuse(part.position, text)


def _of_variable(kind: tree.TypeName) -> tree.TypeName:
    return replace(kind, name=("std", "vector")) if kind.name == ("[]",) else kind


def _number(at: Position, text: str) -> tree.Expression:
    if text[0] in "+-":
        return tree.UnaryExpression(at, text[0], tree.NumberLiteral(at, text[1:]))
    return tree.NumberLiteral(at, text)


def _text(at: Position, text: str) -> tree.Expression:
    return tree.StringLiteral(at, text.encode())


def _cancelling(known: tree.Specification, topic: str, name: str) -> tree.Specification:
    """Cancel all goals of an action where the text stops its topic, whose messages are dropped instead."""
    at = known.position
    everything = tree.Declaration(
        at, tree.TypeName(at, ("actionlib_msgs", "GoalID")), (tree.Declarator(at, _ALL_GOALS),)
    )
    drop, cancel = tree.DropStatement(at), tree.PublishStatement(
        at, _CANCEL, _GOAL_ID, at, tree.Name(at, (_ALL_GOALS,))
    )  # fmt: skip
    events = tuple(
        replace(event, action=_stopping(event.action, drop))
        if isinstance(event.trigger, tree.MessageTrigger) and event.trigger.topic == topic
        else event
        for event in known.events
    )
    cancelled = tree.TopicDeclaration(at, _CANCEL, tree.cancelling(name), cancels=topic)
    givens = tuple(
        part for given in known.givens for part in ((given, cancelled) if given.name == topic else (given,))
    )
    known = replace(known, events=events, givens=givens, declarations=(everything, *known.declarations))
    return _stopping(known, cancel)


def _stopping(node: _T, instead: tree.Statement) -> _T:
    return _change(
        node,
        lambda part: (
            replace(instead, position=part.position) if isinstance(part, tree.StopStatement) else None
        ),
    )


def _with_values_of_roles(known: tree.Specification, topics: Iterable[_Chosen]) -> tree.Specification:
    """Give variables of the type `Role::value` the type that the value has in the chosen row."""
    types: dict[tuple[str, ...], tree.TypeName] = {}
    for chosen in topics:
        for parameter in (*chosen.role.parameters, *chosen.row.parameters):
            types[chosen.role.name, parameter.name] = _of_variable(parameter.type)
    if not types:
        return known
    return _change(known, lambda part: types.get(part.name) if isinstance(part, tree.TypeName) else None)


def _move(node: _T, at: Position) -> _T:
    """Return a part of a role with the position of the event that it is used in."""
    return _change(node, lambda _part: None, at)


def _change(
    node: _T, change: Callable[[tree.SyntaxNode], tree.SyntaxNode | None], at: Position | None = None
) -> _T:
    """Return a tree with changed nodes, and if `at` is given, with this position everywhere."""
    if isinstance(node, tuple):
        return cast("_T", tuple(_change(part, change, at) for part in node))
    if isinstance(node, Position):
        return cast("_T", at or node)
    if not isinstance(node, tree.SyntaxNode):
        return node
    new = change(node)
    if new is None:
        names = (each.name for each in fields(node))
        parts = zip(names, tree.fields_of(node), strict=True)
        new = replace(node, **{name: _change(part, change, at) for name, part in parts})
    return cast("_T", new)
