"""Generates, for each type that is used: a zero value, a copy, decoding, encoding, the length in bytes.

A message is the list of its fields; numbers that follow each other are read and written with one call.
"""

import itertools

from appliance.rosmop.compile.module import Module
from appliance.rosmop.ir.values import BILLION, Values, struct_code, struct_size
from appliance.rosmop.runtime import vectors, wire
from appliance.rosmop.types import kinds
from appliance.rosmop.types.kinds import Type
from appliance.rosmop.types.messages import Messages, Slot


class Codecs(Values):
    """Makes the functions of each type once and knows their names."""

    def __init__(self, module: Module, messages: Messages) -> None:
        super().__init__(messages)
        self._module = module
        self._made: dict[tuple[str, Type], str] = {}
        for name in ("text", "text_end", "count", "numbers", "moments", "elements", "skip", "skip_inner"):
            module.namespace[f"w_{name}"] = getattr(wire, name)
        for name in ("put_text", "put_numbers", "put_moments"):
            module.namespace[f"w_{name}"] = getattr(wire, name)
        for name in ("copied", "copied_deep", "filled", "fixed"):
            module.namespace[f"l_{name}"] = getattr(vectors, name)
        module.namespace |= {"w_len": len, "w_range": range}

    # Values

    def zero_text(self, kind: Type) -> str:
        """An expression for a zero value."""
        if isinstance(kind, kinds.Bool):
            return "False"
        if isinstance(kind, kinds.Floating):
            return "0.0"
        if isinstance(kind, kinds.Integer | kinds.Time | kinds.Duration):
            return "0"
        if isinstance(kind, kinds.String | kinds.Characters):
            return "b''"
        if isinstance(kind, kinds.Vector) and kind.length is None:
            return "[]"
        return f"{self.maker(kind)}()"

    def maker(self, kind: Type) -> str:
        """The name of a function that makes a zero value."""
        key = ("zero", kind)
        if key in self._made:
            return self._made[key]
        if isinstance(kind, kinds.Record):
            zeros = [self.zero_text(slot.type) for slot in self._messages.slots(kind.name).values()]
            body = f"[{', '.join(zeros)}]"
        elif isinstance(kind, kinds.Vector) and kind.length is not None:
            zero = self.zero_text(kind.element)
            scalar = kinds.is_scalar(kind.element)
            body = f"[{zero}] * {kind.length}" if scalar else f"[{zero} for _ in w_range({kind.length})]"
        else:
            body = self.zero_text(kind)
        name = self._made[key] = self._module.fresh("z")
        self._module.add([(f"def {name}():", -1), (f"    return {body}", -1)])
        return name

    def copy_text(self, kind: Type, context: str, code: str, site: int) -> str:
        """An expression for a copy of a value."""
        if kinds.is_scalar(kind):
            return code
        return f"{self._copier(kind)}({context}, {code}, {site})"

    def _copier(self, kind: Type) -> str:
        key = ("copy", kind)
        if key in self._made:
            return self._made[key]
        if isinstance(kind, kinds.Record):
            slots = self._messages.slots(kind.name).values()
            parts = [self._copied(slot.type, f"v[{slot.index}]") for slot in slots]
            body = f"[{', '.join(parts)}]"
        else:
            assert isinstance(kind, kinds.Vector)  # scalars are not copied
            width = self.width(kind.element)
            if kinds.is_scalar(kind.element):
                body = f"l_copied(c, v, {width}, s)"
            else:
                body = f"l_copied_deep(c, v, {width}, {self._copier(kind.element)}, s)"
        name = self._made[key] = self._module.fresh("y")
        self._module.add([(f"def {name}(c, v, s):", -1), (f"    return {body}", -1)])
        return name

    def _copied(self, kind: Type, code: str) -> str:
        return code if kinds.is_scalar(kind) else f"{self._copier(kind)}(c, {code}, s)"

    # Decoding

    def decode_text(self, kind: Type, buffer: str, start: str) -> str:
        """An expression for the pair of the value at `start` and where it ends."""
        if isinstance(kind, kinds.String):
            return f"w_text({buffer}, {start})"
        return f"{self.decoder(kind)}({buffer}, {start})"

    def decoder(self, kind: Type) -> str:
        """The name of the function that decodes a value: from buffer and start to value and end."""
        if isinstance(kind, kinds.String):
            return "w_text"
        key = ("decode", kind)
        if key not in self._made:
            lines = self._decode_lines(kind)
            name = self._made[key] = self._module.fresh("d")
            self._module.add([(f"def {name}(b, p):", -1), *((f"    {line}", -1) for line in lines)])
        return self._made[key]

    def _decode_lines(self, kind: Type) -> list[str]:
        if isinstance(kind, kinds.Record):
            lines: list[str] = []
            values: dict[int, str] = {}
            for fixed, run in self._runs(kind):
                lines += self._decode_run(run, values) if fixed else self._decode_slot(run[0], values)
            return [*lines, f"return [{', '.join(values[index] for index in sorted(values))}], p"]
        if isinstance(kind, kinds.Vector):
            return self._decode_vector_lines(kind)
        code = struct_code(kind) or ""
        unpack, size = self._module.struct("<" + code, "unpack_from"), struct_size(code)
        if len(code) == 2:
            return [f"q, r = {unpack}(b, p)", f"return q * {BILLION} + r, p + {size}"]
        return [f"return {unpack}(b, p)[0], p + {size}"]

    def _decode_vector_lines(self, kind: kinds.Vector) -> list[str]:
        lines = []
        number = str(kind.length)
        if kind.length is None:
            lines = [f"n = w_count(b, p, {self.least(kind.element)})", "p += 4"]
            number = "n"
        code = struct_code(kind.element)
        if code is None:
            return [*lines, f"return w_elements(b, p, {number}, {self.decoder(kind.element)})"]
        if len(code) == 2:
            return [*lines, f"return w_moments(b, p, {number}, {code[0]!r})"]
        return [*lines, f"return w_numbers(b, p, {number}, {code!r}, {struct_size(code)})"]

    def _decode_run(self, run: list[Slot], values: dict[int, str]) -> list[str]:
        codes, names = "", []
        for slot in run:
            code = struct_code(slot.type) or ""
            codes += code
            if len(code) == 2:
                names += [f"q{slot.index}", f"r{slot.index}"]
                values[slot.index] = f"q{slot.index} * {BILLION} + r{slot.index}"
            else:
                names.append(f"f{slot.index}")
                values[slot.index] = f"f{slot.index}"
        unpack = self._module.struct("<" + codes, "unpack_from")
        return [f"{', '.join(names)}, = {unpack}(b, p)", f"p += {struct_size(codes)}"]

    def _decode_slot(self, slot: Slot, values: dict[int, str]) -> list[str]:
        values[slot.index] = f"f{slot.index}"
        return [f"f{slot.index}, p = {self.decode_text(slot.type, 'b', 'p')}"]

    def _runs(self, kind: kinds.Record) -> list[tuple[bool, list[Slot]]]:
        """The fields in groups: numbers that follow each other, or one field of another kind."""
        groups = []
        slots = self._messages.slots(kind.name).values()
        for fixed, run in itertools.groupby(slots, lambda slot: struct_code(slot.type) is not None):
            together = list(run)
            groups += [(True, together)] if fixed else [(False, [slot]) for slot in together]
        return groups

    # Encoding

    def encoder(self, kind: Type) -> str:
        """The name of the function that appends the bytes of a value to a bytearray."""
        if isinstance(kind, kinds.String):
            return "w_put_text"
        key = ("encode", kind)
        if key not in self._made:
            lines = self._encode_lines(kind)
            name = self._made[key] = self._module.fresh("n")
            body = [f"    {line}" for line in lines or ["pass"]]
            self._module.add([(f"def {name}(v, o):", -1), *((line, -1) for line in body)])
        return self._made[key]

    def _encode_lines(self, kind: Type) -> list[str]:
        if isinstance(kind, kinds.Record):
            lines = []
            for fixed, run in self._runs(kind):
                if fixed:
                    lines.append(f"o += {self.pack([(slot.type, f'v[{slot.index}]') for slot in run])}")
                else:
                    lines.append(f"{self.encoder(run[0].type)}(v[{run[0].index}], o)")
            return lines
        if isinstance(kind, kinds.Vector):
            return self._encode_vector(kind)
        return [f"o += {self.pack([(kind, 'v')])}"]

    def _encode_vector(self, kind: kinds.Vector) -> list[str]:
        pack = self._module.struct("<I", "pack")
        lines = [f"o += {pack}(w_len(v))"] if kind.length is None else [f"l_fixed(v, {kind.length}, -1)"]
        code = struct_code(kind.element)
        if code is None:
            return [*lines, "for e in v:", f"    {self.encoder(kind.element)}(e, o)"]
        function = "w_put_moments" if len(code) == 2 else "w_put_numbers"
        return [*lines, f"{function}(v, {code[0]!r}, o)"]

    def pack(self, values: list[tuple[Type, str]]) -> str:
        """An expression for the bytes of values of fixed size."""
        codes, arguments = "", []
        for kind, code in values:
            struct_codes = struct_code(kind) or ""
            codes += struct_codes
            arguments.append(f"{code} // {BILLION}, {code} % {BILLION}" if len(struct_codes) == 2 else code)
        return f"{self._module.struct('<' + codes, 'pack')}({', '.join(arguments)})"
