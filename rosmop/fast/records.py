"""Messages that are made or kept: fields that are put into them, copies, and what is published of them.

Each has its own part of the memory and stands there as it is sent, but of a string stands its address and length; of
an array of any length where its elements are and how many (`arrays.py`): those of strings or messages are beyond.
Strings of one that is kept are as `texts.py` has them.

Whatever is put there has one encoding only: what has several in the message that it comes from (a truth, a time with
too many nanoseconds) is written anew, and a message that puts a NaN there is left. So what is published is copied.
"""

from collections.abc import Iterator, Sequence
from functools import partial

from rosmop.fast.abi import BEYOND, MOST_KEPT, POSITION, ROOM, SAID
from rosmop.fast.arrays import Arrays
from rosmop.fast.codegen_access import loaded, root, root_of
from rosmop.fast.deferred_output import HEAD, Line, Publication
from rosmop.fast.layout import HEAP, LINES, MOST_MADE, NotScalarError, machine_type
from rosmop.fast.vectors_codegen import OF_VECTORS
from rosmop.fast.wasm import COMPARE, F32, F64, I32, I64, MOVES, STORE, constant, unsigned
from rosmop.form import nodes
from rosmop.runtime.values import is_array, struct_code, struct_size
from rosmop.types import kinds
from rosmop.types.kinds import Type

_CHANGING = ("a_slot", *OF_VECTORS)
"""Functions that put something into a message, or into an array in one."""


class Records(Arrays):
    """Writes what makes messages. `_assigned_fields` are those that `Whole` has, by the names of what is pending."""

    _assigned_fields: dict[str, Sequence[nodes.Write]]
    _messages: frozenset[str] = frozenset()
    """The local variables that are messages with a place of their own; of others it is that of what they are."""

    def _own_places(self, function: nodes.Function | nodes.Skipper) -> None:
        """Find out which local variables have a place of their own: whatever may differ from where it came from."""
        self._assigned_fields = {}
        given = function.parameters if isinstance(function, nodes.Function) else ()
        inner = [*nodes.walk(function.body)]
        assigned = [
            (node.name, root_of(node.value))
            for node in inner
            if isinstance(node, nodes.Assign)
            and isinstance(node.type, kinds.Record)
            and node.name not in (*self._layout.shared, *given)
        ]
        changed = {
            root_of(node.arguments[0])
            for node in inner
            if isinstance(node, nodes.Call) and node.function in _CHANGING
        }
        made = {
            name
            for name, source in assigned
            if not source or source in self._layout.shared or name in changed
        }
        while more := {name for name, source in assigned if source in made} - made:
            made |= more
        self._messages = frozenset(made)

    def _is_own(self, name: str) -> bool:
        return name in self._messages or name in self._layout.shared

    def _place(self, node: nodes.Expression) -> tuple[bytes, bytes]:
        if isinstance(node, nodes.Read) and node.name in self._layout.shared:
            place = constant(I32, self._layout.record(node.name, node.type))
            return self._if_known(node.name), place
        if isinstance(node, nodes.Copy) and root_of(node) in self._layout.shared:
            raise NotScalarError(
                "a copy of a message that is kept"
            )  # that may be changed while this is looked at
        if isinstance(node, nodes.Whole):
            place = constant(I32, self._layout.made(node.type))
            return self._put_message(place, 0, node, kept=False), place
        return super()._place(node)

    def _elements(self, node: nodes.Expression) -> tuple[bytes, bytes, bytes]:
        if isinstance(node, nodes.Copy) and isinstance(node.value, nodes.Item) and is_array(node.type):
            return self._of_array(node)
        if isinstance(node, nodes.Copy) and self._is_message(node.value):
            raise NotScalarError("a copy of an array in a message that is made")  # as above
        if not isinstance(node, nodes.Item) or not (
            isinstance(node.type, kinds.String) or is_array(node.type)
        ):
            return super()._elements(node)
        first, place = self._place(node.base)
        name, at = f"text {len(self._locals)}", self._layout.offset(node.base.type, node.number)
        begin, length = (self._get(name) + b"\x28\x00" + unsigned(at + more) for more in (0, 4))
        unknown = length + constant(I32, BEYOND) + b"\x46"
        code = first + place + self._set(name) + self._when(unknown, self._elsewhere)
        if is_array(node.type):
            first, begin, length = self._noted(begin + length + b"\xad")
            return code + first, begin, length
        return code, begin, length + b"\xad"

    def _if_known(self, name: str) -> bytes:
        """The message is left where a variable is not here."""
        known = self._cell(0x29, self._layout.shared[name].known[name])
        return self._when(known + b"\x50", self._elsewhere)

    def _assigned_record(self, node: nodes.Assign) -> bytes:
        """Give a message to a variable."""
        if node.name in self._layout.shared:
            at = self._layout.record(node.name, node.type)
            self._assigned.add(node.name)
            put = self._put_value(constant(I32, at), 0, node.type, node.value, kept=True)
            return self._if_known(node.name) + put
        name = f"place of {node.name}"
        if node.name not in self._messages:
            return b"".join(self._place(node.value)) + self._set(name)
        code = constant(I32, self._layout.made(node.type)) + self._set(name)
        return code + self._put_value(self._get(name), 0, node.type, node.value, kept=False)

    # What is put into one

    def _changes_message(self, node: nodes.Expression) -> bool:
        """Whether it puts something into a message that is made or kept here."""
        if not isinstance(node, nodes.Call) or node.function not in ("a_slot", "a_put"):
            return False
        return self._is_message(node.arguments[0]) and not is_array(node.arguments[0].type)

    def _is_message(self, node: nodes.Expression) -> bool:
        """Whether it is in a message that is made or kept here."""
        found = root(node)
        return found is not None and isinstance(found.type, kinds.Record) and self._is_own(found.name)

    def _change(self, node: nodes.Call) -> bytes:
        """Put a value into a field, or into an element of an array of fixed length."""
        base = node.arguments[0]
        kept = root_of(base) in self._layout.shared
        with self._apart(base):
            code = self._put_part(node, kept=kept)
        if kept:
            self._assigned.add(root_of(base))  # it stands here; one that cannot was refused above
        return code

    def _put_part(self, node: nodes.Call, *, kept: bool) -> bytes:
        base, where, value = node.arguments
        if node.function == "a_slot":
            assert isinstance(where, nodes.Literal)  # noqa: S101  the number of a field
            number = int(where.value or 0)
            first, place = self._place(base)
            kind, offset = self._layout.field(base.type, number), self._layout.offset(base.type, number)
            return first + self._put_value(place, offset, kind, value, kept=kept)
        name = f"element {len(self._locals)}"
        kind, _ = self._layout.element(base.type)
        address = self._address_of(nodes.Call(value.type, "l_element", (base, where), node.site))
        return address + self._set(name) + self._put_value(self._get(name), 0, kind, value, kept=kept)

    def _put_value(
        self, place: bytes, offset: int, kind: Type, value: nodes.Expression, *, kept: bool
    ) -> bytes:
        """Put a value of this type so many bytes behind a place; `kept`: in a variable of the set."""
        if is_array(kind):
            if value.type != kind:
                raise NotScalarError(str(value.type))
            return self._give_array(place, offset, value, kept=kept)
        if isinstance(kind, kinds.Record | kinds.Vector):
            return self._put_whole(place, offset, kind, value, kept=kept)
        if isinstance(kind, kinds.String):
            first, begin, length = self._elements(value)
            long = length + constant(I64, MOST_KEPT) + b"\x56"
            code = first + (self._when(long, self._elsewhere) if kept else b"")
            code += place + begin + b"\x36\x00" + unsigned(offset)
            return code + place + length + b"\xa7\x36\x00" + unsigned(offset + 4)
        if struct_code(kind) != struct_code(value.type):
            raise NotScalarError(str(value.type))
        return self._put_number(place, offset, kind, self._value(value))

    def _put_number(self, place: bytes, offset: int, kind: Type, value: bytes) -> bytes:
        codes, machine = struct_code(kind) or "", machine_type(kind)
        store = bytes((STORE[struct_size(codes)], 0)) + unsigned(offset)
        if machine in (F32, F64):
            kept = f"kept {machine}"
            none = self._get(kept, machine) + self._get(kept, machine) + bytes((COMPARE[machine]["!="],))
            code = value + self._set(kept, machine) + self._when(none, self._elsewhere)
            bits = b"\xbc" if machine == F32 else b"\xbd"
            return code + place + self._get(kept, machine) + bits + store
        code = b""
        if len(codes) == 2:
            code, value = self._parts_of(kind, value)
        return code + place + value + store

    def _put_whole(
        self, place: bytes, offset: int, kind: Type, value: nodes.Expression, *, kept: bool
    ) -> bytes:
        """A message, or an array of fixed length: zeros, or a copy."""
        if value.type != kind:
            raise NotScalarError(str(value.type))
        if isinstance(value, nodes.Whole):
            return self._put_message(place, offset, value, kept=kept)
        size = self._layout.extent(kind)
        if isinstance(value, nodes.Zero):
            return b"".join(
                place
                + constant(I64 if some == 8 else I32, 0)
                + bytes((STORE[some], 0))
                + unsigned(offset + at)
                for at, some in _pieces(size)
            )
        code, own = b"", self._is_own(root_of(value)) or bool(self._spans(kind))
        if isinstance(value, nodes.Copy):
            value = value.value
            code = b"".join(self._allocated(constant(I64, made)) for made in self._layout.arrays(kind))
        elif own:
            raise NotScalarError("two names of one message")
        source = f"source {len(self._locals)}"
        code += b"".join(self._place(value)) + self._set(source)
        arrays = {at for at, leaf in self._layout.leaves(kind) if is_array(leaf)}
        for at, size in self._spans(kind):
            count = self._get(source) + b"\x35\x00" + unsigned(at + 4)
            most = ROOM // size if at in arrays else MOST_KEPT
            if kept:
                code += self._when(count + constant(I64, most) + b"\x56", self._elsewhere)
            if at in arrays:
                code += self._allocated(count + constant(I64, size) + b"\x7e")
        code += self._stay() if arrays else b""
        return code + self._copy_of(place, offset, kind, source, own=own)

    def _spans(self, kind: Type) -> list[tuple[int, int]]:
        """Where it is noted in a message where strings and arrays of any length are, and the bytes of an element."""
        return [
            (at, self._layout.element(leaf)[1])
            for at, leaf in self._layout.leaves(kind)
            if not struct_code(leaf)
        ]

    def _copy_of(self, place: bytes, offset: int, kind: Type, source: str, *, own: bool) -> bytes:
        """Copy what stands where a local variable says; `own`: it is such a message itself."""
        from_there = self._get(source)
        if own:
            return b"".join(
                place
                + from_there
                + bytes((MOVES[some][0], 0))
                + unsigned(at)
                + bytes((STORE[some], 0))
                + unsigned(offset + at)
                for at, some in _pieces(self._layout.extent(kind))
            )
        self._layout.size(kind)  # fixed: it stands as in a message
        return b"".join(
            self._put_number(place, offset + at, leaf, loaded(from_there, at, leaf))
            for at, leaf in self._layout.leaves(kind)
        )

    def _put_message(self, place: bytes, offset: int, node: nodes.Whole, *, kept: bool) -> bytes:
        """The message at hand, with the fields that were assigned."""
        if node.pending not in self._assigned_fields:
            raise NotScalarError("MESSAGE")
        code, name, at = self._allocated(self._length()), f"within {len(self._locals)}", nodes.Spot(None, 0)
        for to, leaf in self._layout.leaves(node.type):
            if isinstance(leaf, kinds.String):
                code += self._put_text_at(place, offset + to, at, name, kept=kept)
                at = nodes.Spot(name, 0)
                continue
            if is_array(leaf):
                code += self._put_array_at(place, offset + to, at, name, leaf, kept=kept)
                at = nodes.Spot(name, 0)
                continue
            size = self._layout.size(leaf)
            base = self._get("at") + (b"" if at.base is None else self._get(at.base, I64) + b"\xa7\x6a")
            code += self._within(at, size)
            code += self._put_number(place, offset + to, leaf, loaded(base, at.offset, leaf))
            at = at.plus(size)
        for write in self._assigned_fields[node.pending]:
            kind: Type = node.type
            to, where = offset, place
            for number in write.path:
                if not isinstance(number, int):
                    raise NotScalarError("a part of a time that was assigned")
                if isinstance(kind, kinds.Record):
                    kind, to = self._layout.field(kind, number), to + self._layout.offset(kind, number)
                else:
                    if is_array(kind):
                        to, where = 0, where + b"\x28\x00" + unsigned(to)
                    kind, size = self._layout.element(kind)
                    to += number * size
            put = partial(self._put_value, where, to, kind, write.value, kept=kept)
            code += self._when(self._get(write.flag), put)
        return code

    def _put_text_at(self, place: bytes, offset: int, at: nodes.Spot, name: str, *, kept: bool) -> bytes:
        """The string of the message at a position, and the position behind it."""
        begin, length = f"begin {name}", f"length {name}"
        code = self._within(at, 4) + self._position(at.plus(4)) + self._set(begin, I64)
        code += b"".join(self._at(at, 0x35)) + self._set(length, I64)
        code += self._get(begin, I64) + self._get(length, I64) + b"\x7c" + self._set(name, I64)
        code += self._within(nodes.Spot(name, 0), 0)
        if kept:
            code += self._when(self._get(length, I64) + constant(I64, MOST_KEPT) + b"\x56", self._elsewhere)
        code += place + self._get("at") + self._get(begin, I64) + b"\xa7\x6a\x36\x00" + unsigned(offset)
        return code + place + self._get(length, I64) + b"\xa7\x36\x00" + unsigned(offset + 4)

    # What is published

    def _noted_line(self, line: Line | Publication, cost: bytes) -> bytes:
        """Pay for a line of output or a publication, and begin it, where the local variable `line` says then."""
        known = self._layout.lines
        code = self._cell(0x28, SAID) + self._set("line")
        end = self._get("line") + constant(I32, line.size) + b"\x6a"
        full = end + constant(I32, self._layout.said + LINES) + b"\x4b"
        code += self._when(full, self._elsewhere) + self._spend(cost) + self._cell(0x36, SAID, end)
        for offset, head in ((0, constant(I32, len(known))), (4, self._cell(0x28, POSITION))):
            code += self._get("line") + head + b"\x36\x00" + unsigned(offset)
        known.append(line)
        return code

    def _publish(self, node: nodes.Publish) -> bytes:
        """Note a message that is published; elsewhere if it is to be told in full."""
        kind, source = node.kind, f"source {len(self._locals)}"
        size = self._layout.extent(kind)
        if size > MOST_MADE:
            raise NotScalarError(f"{kind} of {size} bytes")
        texts = self._spans(kind)
        arrays = {at for at, leaf in self._layout.leaves(kind) if is_array(leaf)}
        publication = Publication(self._context, node, size, texts)
        counted = self._cell(0x29, self._layout.publication(self._context, node.topic))
        self._publishes.add((self._context, node.topic))
        code = self._when(counted + b"\x50", self._elsewhere)
        code += b"".join(self._place(node.value)) + self._set(source)
        cost = constant(I64, publication.cost)
        for at, size in texts:
            length = self._get(source) + b"\x35\x00" + unsigned(at + 4)
            long = length + constant(I64, HEAP // size if at in arrays else MOST_KEPT) + b"\x56"
            code += self._when(long, self._elsewhere)
            cost += length + constant(I64, size) + b"\x7e\x7c"
        code += self._noted_line(publication, cost) + (self._stay() if arrays else b"")
        own = isinstance(node.value, nodes.Whole) or self._is_own(root_of(node.value)) or bool(texts)
        return code + self._copy_of(self._get("line"), HEAD.size, kind, source, own=own)


def _pieces(size: int) -> Iterator[tuple[int, int]]:
    """Where to load and store how many bytes, of so many."""
    at = 0
    for some in (8, 4, 2, 1):
        while size - at >= some:
            yield at, some
            at += some
