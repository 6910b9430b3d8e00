"""The intermediate form as Python: the text of one function, each line with its site."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from appliance.rosmop.compile.module import Lines, Module
from appliance.rosmop.ir import form
from appliance.rosmop.ir.functions import CHARGING, FAULTING, FUNCTIONS
from appliance.rosmop.ir.values import BILLION, Values, struct_code, struct_size, zero_of
from appliance.rosmop.runtime import numbers, output, times, vectors, wire
from appliance.rosmop.runtime.context import MAX_CALLS, FaultError
from appliance.rosmop.types import kinds
from appliance.rosmop.types.kinds import Type

_BITS = frozenset({"&", "|", "^"})


def _too_deep(site: int, name: str) -> None:
    raise FaultError(site, f"`{name}` calls itself without end")


NAMESPACE: Mapping[str, object] = MappingProxyType(
    {
        **FUNCTIONS,
        "c_f32": numbers.f32,
        "c_f32_integer": numbers.f32_of_integer,
        "c_truncate": numbers.truncate,
        "c_float": float,
        "c_recast": vectors.recast,
        "c_recast_each": vectors.recast_each,
        "c_signed": vectors.signed,
        "c_unsigned": vectors.unsigned,
        "c_truths": vectors.truths,
        "c_nan": float("nan"),
        "c_inf": float("inf"),
        "e_bytearray": bytearray,
        "e_bytes": bytes,
        "e_too_deep": _too_deep,
        "h_abs": abs,
        "k_sum": vectors.accumulate,
        "o_divide": numbers.divide,
        "o_remainder": numbers.remainder,
        "o_ratio": numbers.ratio,
        "o_time": times.time,
        "o_duration": times.duration,
        "o_weighed": vectors.weighed,
        "p_join": output.join_all,
        "p_formatted": output.formatted,
        "t_bytes": bytes,
        "w_count": wire.count,
        "w_len": len,
        "w_skip": wire.skip,
        "w_skip_inner": wire.skip_inner,
        "w_text_end": wire.text_end,
        "x_whole": wire.whole,
    }
)
"""What the text may use, besides what `Values` makes."""


_TEMPLATES: Mapping[str, str] = MappingProxyType(
    {
        "k_after": "({0} + {1})",
        "k_before": "({0} - {1})",
        "l_empty": "(not {0})",
        "l_last": "(l_len({0}) - 1)",
        "m_is_zero": "({0} == 0)",
        "m_nsec": "({0} % 1000000000)",
        "m_whole": "{0}",
        "m_sec": "({0} // 1000000000)",
        "m_seconds": "({0} / 1000000000)",
        "t_byte": "t_bytes(({0} & 255,))",
        "t_last": "{0}[-1:]",
        "t_zeroed": "({0} + b'\\0')",
    }
)
"""Functions that are quicker written out."""


class Printer:
    """Writes functions of one specification; `context` is the code's name for that of it."""

    def __init__(self, module: Module, values: Values, context: str) -> None:
        self._module = module
        self._values = values
        self._context = context
        self._acts = 0
        self._flags: frozenset[str] = frozenset()
        self._marks: list[int] = []  # sites that assign to fields of the message
        self._site = -1

    def function(self, function: form.Function) -> int:
        """Add a function to the module; returns the line at which its event happens, 0 if it is none's."""
        lines = Lines()
        happens = 0
        self._marks = []
        self._flags = frozenset(
            write.flag
            for statement in function.body
            if isinstance(statement, form.WriteBack | form.Pending)
            for write in statement.writes
        )
        for index, statement in enumerate(function.body):
            if index == function.happens:
                happens = len(lines.lines)
            self._statement(lines, statement)
        if not function.body:
            lines.add("pass")
        if function.happens == len(function.body):
            happens = len(lines.lines)
        header = [(f"def {function.name}({', '.join(function.parameters)}):", -1)]
        if function.shared:
            header.append((f"    global {', '.join(function.shared)}", -1))
        if function.happens is not None:
            header.append(("    b = m.buffer", -1))
        first = self._module.next_line
        self._module.add(header + lines.lines)
        return first + len(header) + happens

    # Statements

    def _block(self, lines: Lines, statements: Sequence[form.Statement]) -> None:
        lines.depth += 1
        for statement in statements:
            self._statement(lines, statement)
        if not statements:
            lines.add("pass")
        lines.depth -= 1

    def _statement(self, lines: Lines, node: form.Statement) -> None:
        lines.site = self._site = node.site
        _STATEMENTS[type(node)](self, lines, node)

    def _evaluate(self, lines: Lines, node: form.Evaluate) -> None:
        value = node.value.value if isinstance(node.value, form.Discard) else node.value
        if isinstance(value, form.Assign):
            lines.add(f"{value.name} = {self._assigned(value)}")
        elif isinstance(value, form.Call) and value.function == "a_slot" and _is_there(value.arguments[0]):
            base, slot, new = map(self.text, value.arguments)
            lines.add(f"{base}[{slot}] = {new}")
        else:
            lines.add(self.text(value))

    def _if(self, lines: Lines, node: form.If) -> None:
        lines.add(f"if {self.text(node.test)}:")
        self._branch(lines, node, node.yes)
        if node.no:
            lines.site = node.site
            lines.add("else:")
            self._branch(lines, node, node.no)

    def _branch(self, lines: Lines, node: form.If, statements: Sequence[form.Statement]) -> None:
        """What drops or changes the message, or publishes one, can say which conditions led there."""
        begins, acts = len(lines.lines), self._acts
        self._block(lines, statements)
        if self._acts > acts:
            line = f"{'    ' * (lines.depth + 1)}{self._looked(node.site)}"
            lines.lines.insert(begins, (line, node.site))

    def _looked(self, site: int) -> str:
        values = "".join(f"{code}, " for _, code, _, _ in self._module.sites[site].compared)
        return f"{self._context}.turn.looked[{site}] = ({values})"

    def _loop(self, lines: Lines, node: form.Loop) -> None:
        lines.add("while True:")
        self._block(lines, node.body)

    def _for_each(self, lines: Lines, node: form.ForEach) -> None:
        lines.add(f"for {node.name} in {self.text(node.values)}:")
        self._block(lines, node.body)

    def _break(self, lines: Lines, _node: form.Break) -> None:
        lines.add("break")

    def _continue(self, lines: Lines, _node: form.Continue) -> None:
        lines.add("continue")

    def _select(self, lines: Lines, node: form.Select) -> None:
        table = ", ".join(f"{constant}: {index}" for constant, index in node.table)
        lines.add(f"{node.name} = {{{table}}}.get({self.text(node.value)}, {node.default})")

    def _return(self, lines: Lines, node: form.Return) -> None:
        value = self.text(node.value)
        handed = "".join(f", {name}" for name in node.references)
        lines.add(f"return ({value}{handed})" if handed else f"return {value}")

    def _leave(self, lines: Lines, node: form.Leave) -> None:
        lines.add("return" if node.happened is None else f"return {node.happened}")

    def _charge(self, lines: Lines, node: form.Charge) -> None:
        lines.add(f"{self._context}.budget -= {node.instructions}")
        lines.add(f"if {self._context}.budget < 0: {self._context}.spend(0, {node.site})")

    def _allocate(self, lines: Lines, node: form.Allocate) -> None:
        if node.size is None:
            lines.add(f"if w_len(b) > {form.CHARGED}: {self._context}.allocate(w_len(b), {node.site})")
        else:
            lines.add(f"{self._context}.allocate({node.size}, {node.site})")

    def _limit_depth(self, lines: Lines, node: form.LimitDepth) -> None:
        lines.add(f"if n > {MAX_CALLS}: e_too_deep({node.site}, {node.name!r})")

    def _drop(self, lines: Lines, node: form.Drop) -> None:
        self._acts += 1
        lines.add(f"{'' if node.anyway else 'if m is not None: '}m.dropped, m.cause = True, {node.site}")

    def _reset(self, lines: Lines, _node: form.Reset) -> None:
        lines.add(f"{self._context}.turn.reset = True")

    def _publish(self, lines: Lines, node: form.Publish) -> None:
        self._acts += 1
        lines.add(f"{node.name} = e_bytearray()")
        encoder = self._module.use(self._values.encoder(node.kind))
        lines.add(f"{encoder}({self.text(node.value)}, {node.name})")
        arguments = f"{node.topic!r}, {node.kind.name!r}, e_bytes({node.name}), {node.site}"
        lines.add(f"{self._context}.publish({arguments})")

    # Fields

    def _after_text(self, lines: Lines, node: form.AfterText) -> None:
        length = self._module.struct("<I", "unpack_from")
        lines.add(f"{node.name} = {spot(node.at.plus(4))} + {length}(b, {spot(node.at)})[0]")

    def _count(self, lines: Lines, node: form.Count) -> None:
        lines.add(f"{node.name} = w_count(b, {spot(node.at)}, {node.least})")

    def _after_elements(self, lines: Lines, node: form.AfterElements) -> None:
        lines.add(f"{node.name} = {spot(node.at)} + {node.count} * {node.size}")

    def _skip(self, lines: Lines, node: form.Skip) -> None:
        name = "w_skip_inner" if node.inner else "w_skip"
        skipper = "w_text_end" if node.skipper is None else self._skipper(node.skipper)
        lines.add(f"{node.name} = {name}(b, {spot(node.at)}, {node.count}, {skipper}, {self._context})")

    def _skipper(self, skipper: form.Skipper) -> str:
        if not self._module.has(skipper.name):
            inner = Lines()
            for statement in skipper.body:
                self._statement(inner, statement)
            end = (f"    return {spot(skipper.end)}", -1)
            self._module.add([(f"def {skipper.name}(b, p):", -1), *inner.lines, end])
        return skipper.name

    def _not_past(self, lines: Lines, node: form.NotPast) -> None:
        lines.add(f"if {node.count} <= {node.index}:")
        lines.add(f"    m.past = ({node.site}, {node.index}, {node.count})")
        lines.add("    return False")

    def _read_numbers(self, lines: Lines, node: form.ReadNumbers) -> None:
        codes, names, at, moments = "<", [], 0, []
        for name, kind, offset in node.fields:
            code = struct_code(kind) or ""
            codes += (f"{offset - at}x" if offset > at else "") + code
            at = offset + struct_size(code)
            if len(code) == 2:
                names += [f"{name}_{index}" for index in range(2)]
                moments.append(f"{name} = {name}_0 * 1000000000 + {name}_1")
            else:
                names.append(name)
        unpack = self._module.struct(codes, "unpack_from")
        lines.add(f"{', '.join(names)}, = {unpack}(b, {spot(node.at)})")
        lines.extend(moments)

    def _read_value(self, lines: Lines, node: form.ReadValue) -> None:
        decoder = self._module.use(self._values.decoder(node.type))
        lines.add(f"{node.name}, {node.end} = {decoder}(b, {spot(node.at)})")

    def _require(self, lines: Lines, node: form.Require) -> None:
        lines.add(f"if not {self.text(node.test)}: return False")
        lines.add(self._looked(node.site))

    def _pending(self, lines: Lines, node: form.Pending) -> None:
        entries = [f"({write.flag}, {write.path!r}, {self.text(write.value)})" for write in node.writes]
        told = f"({', '.join(entries)},)" if entries else "()"
        lines.add(f"{node.name} = lambda: {told}")

    def _write_back(self, lines: Lines, node: form.WriteBack) -> None:
        """What can fault, the encoding of fields of variable size, comes before the first byte is written."""
        lines.add("if m.dropped: return True")
        if node.writes:
            lines.add(f"m.marks = ({''.join(f'{site}, ' for site in self._marks)})")
        spliced = [write for write in node.writes if write.end is not None]
        if spliced:
            lines.add(f"{node.name} = []")
        for write in spliced:
            lines.add(f"if {write.flag}:")
            lines.add("    o = e_bytearray()")
            encoder = self._module.use(self._values.encoder(write.value.type))
            lines.add(f"    {encoder}({self.text(write.value)}, o)")
            lines.add(f"    {node.name}.append(({spot(write.at)}, {write.end}, e_bytes(o), {write.flag}))")
        for write in node.writes:
            if write.end is None:
                codes, value = struct_code(write.value.type) or "", self.text(write.value)
                parts = f"{value} // {BILLION}, {value} % {BILLION}" if len(codes) == 2 else value
                packed = f"{self._module.struct('<' + codes, 'pack')}({parts})"
                lines.add(f"if {write.flag}: m.patch({spot(write.at)}, {packed}, {write.flag})")
        if spliced:
            lines.add(f"if {node.name}: m.splice({node.name})")

    # Expressions

    def text(self, node: form.Expression) -> str:
        """An expression."""
        return _EXPRESSIONS[type(node)](self, node)

    def _literal(self, node: form.Literal) -> str:
        constant = node.value
        if isinstance(constant, float):
            if constant != constant:  # noqa: PLR0124  NaN
                return "c_nan"
            if constant - constant != 0:
                return "c_inf" if constant > 0 else "(-c_inf)"
            return repr(constant) if constant >= 0 and repr(constant)[0] != "-" else f"({constant!r})"
        if isinstance(constant, int) and not isinstance(constant, bool) and constant < 0:
            return f"({constant})"
        return repr(constant)

    def _read(self, node: form.Read) -> str:
        return node.name

    def _assign(self, node: form.Assign) -> str:
        return f"({node.name} := {self._assigned(node)})"

    def _assigned(self, node: form.Assign) -> str:
        """The value; of the flag of a field, which gets another value: the sites that have assigned to it, as bits."""
        if node.name not in self._flags or _constant(node.value) is not True:
            return self.text(node.value)
        self._acts += 1
        if self._site not in self._marks:
            self._marks.append(self._site)
        return f"{node.name} | {1 << self._marks.index(self._site)}"

    def _convert(self, node: form.Convert) -> str:
        return converted(self.text(node.value), node.value.type, node.type)

    def _arithmetic(self, node: form.Arithmetic) -> str:
        kind, operator, right = node.type, node.operator, self.text(node.right)
        if isinstance(kind, kinds.Floating):
            return self._floating(node, kind)
        assert isinstance(kind, kinds.Integer)  # the common type of two numbers
        left = self.text(node.left)
        if operator in ("<<", ">>"):
            shifted = f"{left} {operator} ({right} & {kind.bits - 1})"
            return wrapped(f"({shifted})", kind) if operator == "<<" else f"({shifted})"
        if operator in ("/", "%"):
            return self._division(node, left, right, kind)
        if operator in _BITS:
            return f"({left} {operator} {right})"
        return wrapped(f"{left} {operator} {right}", kind)

    def _division(self, node: form.Arithmetic, left: str, right: str, kind: kinds.Integer) -> str:
        divisor = _constant(node.right)
        if not kind.signed and isinstance(divisor, int) and divisor > 0:
            return f"({left} {'//' if node.operator == '/' else '%'} {right})"  # of what is not negative: as Python's
        if node.operator == "/":
            return wrapped(f"o_divide({left}, {right}, {node.site})", kind)
        return f"o_remainder({left}, {right}, {node.site})"

    def _floating(self, node: form.Arithmetic, kind: kinds.Floating) -> str:
        first, second = _beside_double(node.left), node.right
        if first is node.left:
            second = _beside_double(second)
        left, right = self.text(first), self.text(second)
        if node.operator == "/":
            safe = _constant(node.right) not in (None, 0)
            code = f"({left} / {right})" if safe else f"o_ratio({left}, {right})"
        else:
            code = f"({left} {node.operator} {right})"
        return f"c_f32({code})" if kind.bits == 32 else code

    def _unary(self, node: form.Unary) -> str:
        value = self.text(node.value)
        code = f"h_abs({value})" if node.operator == "abs" else f"({node.operator}{value})"
        return wrapped(code, node.type) if isinstance(node.type, kinds.Integer) else code

    def _moment(self, node: form.Moment) -> str:
        function = "o_time" if node.type == kinds.TIME else "o_duration"
        return f"{function}({self.text(node.left)} {node.operator} {self.text(node.right)}, {node.site})"

    def _moment_of(self, node: form.MomentOf) -> str:
        function = "m_time" if node.type == kinds.TIME else "m_duration"
        whole = f"{self.text(node.seconds)} * 1000000000 + {self.text(node.nanoseconds)}"
        return f"{function}({whole}, {node.site})"

    def _compare(self, node: form.Compare) -> str:
        left, right = self._compared(node.left), self._compared(node.right)
        if isinstance(node.left.type, kinds.Vector | kinds.Record):
            measure = self._module.use(self._values.measure(node.left.type))
            left = f"o_weighed({self._context}, {left}, {measure}, {node.site})"
        return f"({left} {node.operator} {right})"

    def _compared(self, node: form.Expression) -> str:
        """An operand; Python compares integers and doubles with each other exactly where it is safe."""
        if isinstance(node, form.Convert) and node.type == kinds.DOUBLE:
            source = node.value.type
            if isinstance(source, kinds.Bool) or (isinstance(source, kinds.Integer) and source.bits <= 32):
                return self.text(node.value)
        return self.text(node)

    def _compare_texts(self, node: form.CompareTexts) -> str:
        left, right = self.text(node.left), self.text(node.right)
        if node.short:
            return f"({left} {node.operator} {right})"
        charged = f"o_charged({self._context}, {left}, {node.site}) {node.operator} {right}"
        known = next((code for code in (right, left) if code.isidentifier()), None)
        if known is None:
            return f"({charged})"
        return f"({left} {node.operator} {right} if l_len({known}) <= {form.SHORT} else {charged})"

    def _logical(self, node: form.Logical) -> str:
        return f"({self.text(node.left)} {node.operator} {self.text(node.right)})"

    def _not(self, node: form.Not) -> str:
        return f"(not {self.text(node.value)})"

    def _conditional(self, node: form.Conditional) -> str:
        return f"({self.text(node.yes)} if {self.text(node.test)} else {self.text(node.no)})"

    def _sequence(self, node: form.Sequence) -> str:
        return f"({', '.join(map(self.text, node.items))})[{node.chosen}]"

    def _discard(self, node: form.Discard) -> str:
        return self.text(node.value)

    def _item(self, node: form.Item) -> str:
        return f"{self.text(node.base)}[{node.number}]"

    def _vector(self, node: form.Vector) -> str:
        code = f"[{', '.join(map(self.text, node.items))}]"
        if node.zeros:
            rest = self._module.use(self._values.maker(kinds.Vector(node.type.element, node.zeros)))
            code = f"({code} + {rest}())"
        return code

    def _zero(self, node: form.Zero) -> str:
        zero = zero_of(node.type)
        if zero is not None:
            return repr(zero)
        if isinstance(node.type, kinds.Vector) and node.type.length is None:
            return "[]"
        return f"{self._module.use(self._values.maker(node.type))}()"

    def _copy(self, node: form.Copy) -> str:
        return self._copied(node.type, self.text(node.value), node.site)

    def _copied(self, kind: Type, code: str, site: int) -> str:
        if kinds.is_scalar(kind):
            return code
        return f"{self._module.use(self._values.copier(kind))}({self._context}, {code}, {site})"

    def _recast(self, node: form.Recast) -> str:
        source = node.value.type
        assert isinstance(source, kinds.Vector)  # as its type is
        return self._recast_elements(self.text(node.value), source.element, node.type.element, node.site)

    def _recast_elements(self, code: str, source: Type, target: Type, site: int) -> str:
        if isinstance(source, kinds.Vector) and isinstance(target, kinds.Vector):
            inner = self._recast_elements("e", source.element, target.element, site)
            return f"c_recast_each({self._context}, {code}, lambda e: {inner}, {site})"
        if isinstance(target, kinds.Bool):
            name = "c_truths"
        else:
            assert isinstance(target, kinds.Integer)  # so says kinds.same_elements
            name = "c_signed" if target.signed else "c_unsigned"
        return f"c_recast({self._context}, {code}, {name}, {site})"

    def _of_type(self, node: form.OfType) -> str:
        if node.what == "zero":
            return self._module.use(self._values.maker(node.of))
        if node.what == "measure":
            return self._module.use(self._values.measure(node.of))
        return f"lambda e: {self._copied(node.of, 'e', node.site)}"

    def _call(self, node: form.Call) -> str:
        arguments = [self.text(argument) for argument in node.arguments]
        template = _TEMPLATES.get(node.function)
        if template is not None:
            return template.format(*arguments)
        before = [self._context] if node.function in CHARGING else []
        after = [str(node.site)] if node.function in FAULTING else []
        return f"{node.function}({', '.join([*before, *arguments, *after])})"

    def _accumulate(self, node: form.Accumulate) -> str:
        assert isinstance(node.vector.type, kinds.Vector)
        element, wide = node.vector.type.element, node.wide
        added = f"{converted('a', node.type, wide)} + {converted('e', element, wide)}"
        result = wrapped(added, wide) if isinstance(wide, kinds.Integer) else f"({added})"
        step = f"lambda a, e: {converted(result, wide, node.type)}"
        span = ", ".join(map(self.text, (node.vector, node.first, node.last)))
        return f"k_sum({self._context}, {span}, {node.site}, {self.text(node.start)}, {step})"

    def _invoke(self, node: form.Invoke) -> str:
        codes = [self.text(argument) for argument in node.arguments]
        if node.depth is not None:
            codes.append("n + 1" if node.depth else "0")
        return f"{node.function}({', '.join(codes)})"

    def _format(self, node: form.Format) -> str:
        row = f"({', '.join(map(self.text, node.arguments))},)"
        if node.size is not None:
            return f"p_formatted({self._context}, {node.template!r}, {row}, {node.size}, {node.site})"
        return f"({node.template!r} % {row})"

    def _join(self, node: form.Join) -> str:
        row = "".join(f"{self.text(piece)}, " for piece in node.pieces)
        return f"p_join({self._context}, ({row}), {node.site})"

    def _log(self, node: form.Log) -> str:
        return f"{self._context}.log({node.level!r}, {self.text(node.text)}, {node.site})"

    def _throttle(self, node: form.Throttle) -> str:
        return f"{self._context}.throttle({self.text(node.seconds)}, {node.site})"

    def _now(self, _node: form.Now) -> str:
        return f"{self._context}.turn.now"

    def _whole(self, node: form.Whole) -> str:
        decoder = self._module.use(self._values.decoder(node.type))
        return f"x_whole(m, {self._context}, {decoder}, {node.pending}(), {node.site})"


def spot(at: form.Spot) -> str:
    """A position."""
    if at.base is None:
        return str(at.offset)
    return f"{at.base} + {at.offset}" if at.offset else at.base


def _constant(node: form.Expression) -> bool | int | float | bytes | str | None:
    """The value of a constant, converted or not; None of anything else."""
    if isinstance(node, form.Convert):
        node = node.value
    return node.value if isinstance(node, form.Literal) else None


def _is_there(node: form.Expression) -> bool:
    """Whether it is a variable, or a field of one: that cannot fault, so that what is put there may come before it."""
    while isinstance(node, form.Item):
        node = node.base
    return isinstance(node, form.Read)


def _beside_double(node: form.Expression) -> form.Expression:
    """What may stand beside a double in its place: Python converts an integer there as C++ does."""
    if (
        isinstance(node, form.Convert)
        and node.type == kinds.DOUBLE
        and isinstance(node.value.type, kinds.Integer)
    ):
        return node.value
    return node


def converted(code: str, source: Type, target: Type) -> str:
    """A number as one of another type."""
    if source == target:
        return code
    if isinstance(target, kinds.Bool):
        return f"({code} != 0)"
    if isinstance(target, kinds.Integer):
        return _to_integer(code, source, target)
    assert isinstance(target, kinds.Floating)  # numbers are one of the three
    if target.bits == 32:
        large = isinstance(source, kinds.Integer) and source.bits == 64
        return f"c_f32_integer({code})" if large else f"c_f32({code})"
    return code if isinstance(source, kinds.Floating) else f"c_float({code})"


def _to_integer(code: str, source: Type, target: kinds.Integer) -> str:
    if isinstance(source, kinds.Bool):
        return f"(+{code})"
    if isinstance(source, kinds.Floating):
        return f"c_truncate({code}, {target.least}, {target.most})"
    assert isinstance(source, kinds.Integer)
    return code if target.holds(source) else wrapped(code, target)


def wrapped(code: str, kind: kinds.Integer) -> str:
    """An integer that may have overflowed, wrapped into its type."""
    mask = (1 << kind.bits) - 1
    if not kind.signed:
        return f"({code} & {mask})"
    half = 1 << (kind.bits - 1)
    return f"(({code} + {half} & {mask}) - {half})"


_EXPRESSIONS: Mapping[type[Any], Callable[[Printer, Any], str]] = form.methods_of(Printer, form.Expression)
_STATEMENTS: Mapping[type[Any], Callable[[Printer, Lines, Any], None]] = form.methods_of(
    Printer, form.Statement
)


def constant_of(node: form.Expression, values: Values) -> bool | int | float:
    """The value of an expression of numbers without variables. Raises `FaultError`."""
    code = Printer(Module(), values, "").text(node)
    value: bool | int | float = eval(code, {"__builtins__": {}, **NAMESPACE})  # noqa: S307  our own code, as in `Module.run`
    return value
