"""Keep the state of a relay's monitors in memory that outlives the process, and read the state of earlier processes.

- A state is written before a message that depends on it is passed on or published, so no subscriber sees an effect of
  a state that can be lost.
- A state is reused only if it was written since the machine started, or before an orderly end of the appliance, and
  the machine's clock was not set since. Otherwise, it is `lost`, with the reason.
- The times in a state are ages: after a takeover, the clock of monitors continues where the other appliance stopped
  it, so different clocks of the machines change no bound.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import msgspec

from appliance.base import clock
from appliance.channel.messages import SpecificationsStated, StateGiven, StateLeft, StateWanted
from appliance.relay.monitors.state_memory import NOT_KEPT, CellsPlace, Memory, StateMemory, StoredState, read

if TYPE_CHECKING:
    from rosmop.run.engine import KeptGroup, MonitorSet
    from rosmop.run.outcomes import Outcome

_UNREADABLE = "its saved state cannot be read"
_NO_ROOM = "the states of all monitors together exceed the limit"
LARGEST_COPY = 1 << 20
"""The largest state, in bytes, that is copied to the other appliance while it changes."""

LEAVING = "the other appliance takes over"
"""Why a relay drops all messages while its appliance hands over."""

_NO_MEMORY = "the previous relay process exited, and the state of monitors is not kept"
_STEP = 1_000_000_000  # nanoseconds; a larger difference means that the clock was set


class _GroupHead(msgspec.Struct, array_like=True):
    """The monitors of a section, and the layout of its cells (`KeptGroup.layout`)."""

    monitors: list[str]
    cells: msgspec.Raw


class _Head(msgspec.Struct, array_like=True):
    """The head of a memory: boot id, offset of the clock and time of writing (ns), heads of the groups.

    `shift` is the part of `offset` that comes from a takeover.
    """

    boot: str
    offset: int
    written: int
    groups: list[_GroupHead]
    lost: str = ""
    """Why no monitor's state is kept; empty if states are kept."""
    shift: int = 0


@dataclass(slots=True)
class RecoveredState:
    """The states that earlier processes left.

    Each of `groups`, newest last, is the names of its monitors, the layout of its cells, its base, and cells that are
    newer than the base. `lost` has the reason why a monitor's state is missing, or, with the key "", that of all.
    """

    groups: list[tuple[list[str], bytes, bytes, bytes | None]] = field(default_factory=list)
    lost: dict[str, str] = field(default_factory=dict)


@dataclass(eq=False, slots=True)
class _Entry:
    """A group of monitors and its section; `base` holds the bytes last written."""

    group: "KeptGroup"
    section: int = 0
    base: bytes = b""
    refused: bool = False
    """Whether the memory has no space for the state; the state is then lost when the process ends."""
    parts: list[bytes] = field(default_factory=list)
    """The parts of the slices (stored in the next sections) as last written."""


class StateKeeper:
    """Keeps the state of one relay in `own`, and recovers it from there or, if that is empty, from `earlier` ones."""

    def __init__(self, given: StateGiven, own: Memory, earlier: Sequence[Memory] = ()) -> None:
        self._given = given
        self._own = own
        self._memory = StateMemory(own)
        self._left = [own] if _has_head(own) else [*earlier]
        self._entries: list[_Entry] = []
        self._by_channel: dict[str, _Entry] = {}
        self._copied: list[tuple[bytes, bytes | None]] | None = None  # the sections of the last copy
        self.shift = 0
        """The nanoseconds that a takeover added to the clock of monitors; `clock_shift` sets it."""

    @property
    def offset(self) -> int:
        """Return the clock of monitors minus the machine's monotonic clock, in nanoseconds."""
        return self._given.offset + self.shift

    # --- state that an earlier process left ---

    def recover(self) -> RecoveredState | None:
        state = RecoveredState()
        heads = sorted(self._readable(state), key=lambda each: each[0].written)
        for head, sections in heads:
            reason = self._distrust(head)
            if head.lost:
                state.lost[""] = head.lost
            lost = msgspec.msgpack.encode(reason), None  # replaces the groups' states in older memories
            for group, section in zip(head.groups, sections, strict=False):
                state.groups.append((group.monitors, bytes(group.cells), *(lost if reason else section)))
        return state if heads or state.lost else None

    def kept_shift(self) -> int:
        heads = [head for head, _sections in self._readable(RecoveredState())]
        return max(heads, key=lambda head: head.written).shift - self.shift if heads else 0

    def _readable(self, state: RecoveredState) -> Iterator[tuple[_Head, list[tuple[bytes, bytes | None]]]]:
        for memory in self._left:
            try:
                kept = read(memory)
                if kept is not None:
                    yield _HEADS.decode(kept.head), kept.sections
            except ValueError as error:
                state.lost[""] = f"{_UNREADABLE}: {error}"

    def _distrust(self, head: _Head) -> str:
        given = self._given
        if head.boot == given.boot:
            set_by = abs(head.offset - head.shift - given.offset)
            return (
                "" if set_by <= _STEP else "the machine's clock was changed while the appliance was stopped"
            )
        if head.boot != given.ended_boot:
            return "the machine stopped (a power cut, a reset) before the appliance did"
        if given.offset + clock.now_ns() < given.ended_at:
            return "the machine's clock was set back while the appliance was stopped"
        return ""

    # --- kept state ---

    def content(self) -> bytes:
        kept = read(self._own)
        if kept is None:
            return b""
        head = msgspec.structs.replace(_HEADS.decode(kept.head), written=self.offset + clock.now_ns())
        return _CONTENT.encode(kept._replace(head=msgspec.msgpack.encode(head)))

    def changed_content(self, *, full: bool) -> bytes | None:
        kept = read(self._own)
        sections = kept.sections if kept is not None else []
        if sections == self._copied and not full:
            return None
        self._copied = sections
        return self.content()

    def take(self, monitors: "MonitorSet") -> None:
        self._entries = [_Entry(group, parts=group.parts()) for group in monitors.kept_groups()]
        self._by_channel = {channel: entry for entry in self._entries for channel in entry.group.channels}
        self._lay_out()

    def take_nothing(self) -> None:
        self._entries, self._by_channel = [], {}
        self._lay_out()

    def keep(self, channel: str) -> bool:
        """Write the state of the channel's monitors; return False if states have moved (see `cells_place`)."""
        entry = self._by_channel.get(channel)
        return entry is None or self._keep(entry)

    def keep_all(self) -> bool:
        stayed = [self._keep(entry) for entry in self._entries]
        return all(stayed)

    def cells_place(self, channel: str) -> CellsPlace | None:
        entry = self._by_channel.get(channel)
        if entry is None or entry.refused:
            return NOT_KEPT
        return None if entry.group.cells() is None else self._memory.cells_place(entry.section)

    def _keep(self, entry: _Entry) -> bool:
        if entry.refused:
            return True
        cells = entry.group.cells()
        if cells is not None:
            if cells:
                self._memory.write_cells(entry.section, cells)
            return True
        if not self._keep_slices(entry):
            self._lay_out()
            return False
        base = entry.group.base()
        if base != entry.base or self._memory.has_cells(entry.section):
            entry.base = base
            if not self._memory.write_base(entry.section, base):
                self._lay_out()
                return False
        return True

    def _keep_slices(self, entry: _Entry) -> bool:
        fits = True
        for number, data in entry.group.changed_parts().items():
            entry.parts[number] = data
            fits = fits and self._memory.write_base(entry.section + 1 + number, data)
        return fits

    def _lay_out(self) -> None:
        for entry in self._entries:
            if not entry.refused:
                entry.base = entry.group.base()
                for number, data in entry.group.changed_parts().items():
                    entry.parts[number] = data
        while not self._memory.lay_out(
            self._head(), [section for entry in self._entries for section in _sections(entry)]
        ):
            rest = [entry for entry in self._entries if not entry.refused]
            if not rest:
                self._entries, self._by_channel = [], {}
                self._memory.lay_out(self._head(_NO_ROOM), [])
                return
            largest = max(rest, key=lambda entry: sum(len(data) for data, _ in _sections(entry)))
            largest.refused, largest.parts = True, []
            largest.base = msgspec.msgpack.encode(_NO_ROOM)
        section = 0
        for entry in self._entries:
            entry.section = section
            section += len(_sections(entry))

    def _head(self, lost: str = "") -> bytes:
        groups = []
        for entry in self._entries:
            groups.append(_GroupHead(entry.group.names, msgspec.Raw(entry.group.layout)))
            if entry.parts:
                groups += [_GroupHead([name], _NO_CELLS) for name in entry.group.part_names]
        written = self.offset + clock.now_ns()
        head = _Head(self._given.boot, self.offset, written, groups, lost, self.shift)
        return msgspec.msgpack.encode(head)


def state_left(message: StateWanted, keeper: StateKeeper | None) -> StateLeft:
    """Return the answer to `StateWanted`; the copy of a state that is too large is empty."""
    if not message.copy:
        return StateLeft(message.number, b"" if keeper is None else keeper.content())
    content = keeper.changed_content(full=message.full) if keeper is not None else b""
    if keeper is None or (content is not None and len(content) > LARGEST_COPY):
        return StateLeft(message.number, b"")
    return StateLeft(message.number, content, keeper.offset + clock.now_ns())


def clock_shift(message: SpecificationsStated, keeper: StateKeeper | None, now: int) -> int:
    """Return the nanoseconds to add to the clock of monitors before their first start.

    The clock continues where the other appliance, or the relay that this one replaces, stopped it.
    """
    shift = 0
    if message.left:
        times = [head.written for _content, head in _left(message.left, RecoveredState())]
        times = [message.left_at] if message.left_at else times
        shift = max(times) - now if times else 0
    elif keeper is not None and not message.lost:
        shift = keeper.kept_shift()
    if keeper is not None:
        keeper.shift += shift
    return shift


def start_outcome(
    monitors: "MonitorSet",
    message: SpecificationsStated,
    keeper: StateKeeper | None,
    now: int,
    *,
    restarted: bool,
) -> "Outcome":
    """Start the first monitors of a relay, with the state of an earlier process or of the other appliance if any.

    `restarted`: this relay replaces a dead one. `now` is the time of monitors (ns).
    """
    left = keeper.recover() if keeper is not None else None
    if message.left or message.lost:
        left = received_states(message.left)
        if message.lost:
            left.lost.setdefault("", message.lost)  # of the monitors without a state in `left`
    elif keeper is None and restarted:
        left = RecoveredState(lost={"": _NO_MEMORY})
    if left is None:
        return monitors.start(now, restarted=restarted)
    return monitors.recover(left.groups, left.lost, now, restarted=restarted)


def received_states(contents: Sequence[bytes]) -> RecoveredState:
    state = RecoveredState()
    for kept, head in _left(contents, state):
        if head.lost:
            state.lost[""] = head.lost
            continue
        for group, section in zip(head.groups, kept.sections, strict=False):
            state.groups.append((group.monitors, bytes(group.cells), *section))
    return state


def _left(contents: Sequence[bytes], state: RecoveredState) -> Iterator[tuple[StoredState, _Head]]:
    for content in filter(None, contents):
        try:
            kept = _CONTENTS.decode(content)
            head = _HEADS.decode(kept.head)
        except ValueError as error:
            state.lost[""] = f"{_UNREADABLE}: {error}"
        else:
            yield kept, head


def _sections(entry: _Entry) -> list[tuple[bytes, int]]:
    return [(entry.base, entry.group.size), *((data, 0) for data in entry.parts)]


_NO_CELLS = msgspec.Raw(b"\xc0")
_CONTENT = msgspec.msgpack.Encoder()
_CONTENTS = msgspec.msgpack.Decoder(StoredState)
_HEADS = msgspec.msgpack.Decoder(_Head)


def _has_head(memory: Memory) -> bool:
    try:
        return read(memory) is not None
    except ValueError:
        return True
