"""Naive models of the guards that listen to nodes and persons: watchdog, enabling device, stop button, mode."""

from lab.closed_loop.messages import STILL, boolean
from tests.unit.features.guards.guarding import seeded
from tests.unit.features.guards.tracing import Trace, motion, near, pause, scaled, slow


def _judge_stops(trace: Trace, ends: list[int], was: int, *, moved: bool) -> None:
    """Judge the stops since `was`, if the motions of nodes end at these times."""
    if ends:
        trace.stopped_within(min(ends), min(ends) + 10)
    new = [at for at in trace.stops if at > was]
    if moved and new:
        assert any(end <= new[0] for end in ends), trace.said("a stop, and no node is silent")
    if ends and new:
        for one, other in zip(new, [*new[1:], trace.now], strict=True):
            assert other - one <= 110, trace.said("the stops are not repeated")


class Run:
    """Since when the commands of a node come, without a gap; and since when they are all motions."""

    def __init__(self) -> None:
        self.heard = self.begun = -(10**9)
        self.motions = 10**9

    def hear(self, at: int, silent: int, *, moves: bool) -> None:
        gap = at - self.heard
        if gap > silent:
            self.begun = at
        if gap >= silent or not moves:
            self.motions = 10**9
        if moves:
            self.motions = min(self.motions, at)
        self.heard = at


def watchdog(seed: int, events: int = 40, slower: float = 1) -> None:
    """Every node's motion ends `silent` + 10 ms after its last command; a motion needs commands for `resume`.

    The guard gets `silent` times `slower`.
    """
    chance = seeded(seed)
    silent, resume = chance.choice((100, 300, 700)), chance.choice((0, 200, 400))
    trace = Trace("deadman", seed, silent=slower * silent / 1000, resume=resume / 1000)
    runs: dict[int, Run] = {}
    moving: dict[int, int] = {}
    """Nodes whose last command is a motion that passed, with its time."""
    nodes = (1, 2, 3) if chance.random() < 0.3 else (1, 2) if chance.random() < 0.6 else (1,)
    for _ in range(events):
        was, moved = trace.now, trace.moving
        trace.wait(pause(chance, silent))
        ends = [at + silent for at in moving.values()]
        _judge_stops(trace, ends, was, moved=moved)
        moving = {
            node: at for node, at in moving.items() if not any(stop > at + silent for stop in trace.stops)
        }
        node, legs = chance.choice(nodes), motion(chance)
        run = runs.setdefault(node, Run())
        run.hear(trace.now, silent, moves=legs != STILL)
        others = sum(1 for other, at in moving.items() if other != node and trace.now - at <= silent)
        lately = [other for other, one in runs.items() if trace.now - one.heard <= 2 * silent + resume]
        may = trace.now - run.begun >= resume and others < 2
        must = trace.now - run.motions > resume and len(lately) <= 2
        drops = bool(moving.keys() - {node})
        passed = trace.judge(legs, node, may=may, must=must, drops=drops)
        moving.pop(node, None)
        if passed:
            moving[node] = trace.now


class Switches:
    """The last message of each node on a topic of switches; `silent` 0 means that they send changes only."""

    def __init__(self, silent: int) -> None:
        self.silent = silent
        self.on: dict[int, bool] = {}
        self.heard: dict[int, int] = {}
        self.off_once: set[int] = set()

    def hear(self, node: int, at: int, *, on: bool) -> None:
        self.on[node], self.heard[node] = on, at
        if not on:
            self.off_once.add(node)

    def due(self) -> list[int]:
        """Return when each node is silent, unless it sends again."""
        return [at + self.silent for at in self.heard.values()] if self.silent else []

    def silence(self, at: int) -> int | None:
        """Return for how long a node has been silent if that is the only reason for a stop."""
        overdue = [at - end for end in self.due()]
        return max(overdue) if overdue and max(overdue) > 0 else None

    def all_heard(self, at: int) -> bool:
        return bool(self.heard) and all(at <= end for end in self.due())

    def all_are(self, state: bool) -> bool:
        return all(on == state for on in self.on.values())


class Zeros:
    """The nodes that have commanded zero since the last stop.

    A timer of `tick` notices a silence. So a shorter one may be a stop, and need not be one.
    """

    def __init__(self, tick: int) -> None:
        self.tick = tick
        self.sure: set[int] = set()
        self.perhaps: set[int] = set()

    def stop(self, silence: int | None = None) -> None:
        """Forget the zeros: at a stop, or after a silence, in ms."""
        self.sure.clear()
        if silence is None or silence > self.tick:
            self.perhaps.clear()

    def add(self, node: int) -> None:
        self.sure.add(node)
        self.perhaps.add(node)


def enabling_device(seed: int, events: int = 40) -> None:
    """A base moves only while all devices are held, each let go once before, and after a zero of the node."""
    chance = seeded(seed)
    silent = chance.choice((100, 300, 500))
    zero_first = chance.random() < 0.8
    trace = Trace("hold_to_run", seed, silent=silent / 1000, zeroFirst=zero_first)
    devices = Switches(silent)
    zeros = Zeros(20)
    hands = (3, 4) if chance.random() < 0.4 else (3,)
    nodes = (1, 2) if chance.random() < 0.3 else (1,)
    period = 60 if len(hands) == 1 else 40

    def held(tick: int = 0) -> bool:
        return (
            devices.all_heard(trace.now - tick)
            and devices.all_are(True)
            and devices.off_once >= devices.on.keys()
        )

    was_silent: set[int] = set()
    for _ in range(events):
        moved, was = trace.moving, trace.now
        dues = devices.due()
        trace.wait(pause(chance, silent, period))
        if moved:
            if dues:
                trace.stopped_within(was, min(dues) + 20)
            if any(at > was for at in trace.stops):
                assert any(end <= trace.now for end in dues), trace.said("a stop, and all devices are held")
        if not held():
            zeros.stop(devices.silence(trace.now))
        was_silent |= {node for node, at in devices.heard.items() if trace.now - at >= silent}
        if chance.random() < 0.5:
            hand = chance.choice(hands)
            on = chance.random() < 0.85
            devices.hear(hand, trace.now, on=on)
            if not on:
                was_silent.discard(hand)
            trace.observe("by", boolean(on), hand, on)
            if not devices.all_are(True):
                zeros.stop()
            if not held():
                assert not trace.moving, trace.said("a device is let go, and the base moves")
            continue
        node, legs = chance.choice(nodes), motion(chance)
        sure, perhaps = node in zeros.sure or not zero_first, node in zeros.perhaps or not zero_first
        if not held():
            zeros.stop(devices.silence(trace.now))
        trace.judge(legs, node, may=held(zeros.tick) and perhaps, must=held() and sure and not was_silent)
        if legs == STILL and held():
            zeros.add(node)
        elif legs == STILL and held(zeros.tick):
            zeros.perhaps.add(node)


def stop_button(seed: int, events: int = 60, *, two_hands: bool = False) -> None:  # noqa: PLR0912  one branch for each kind of event
    """A press latches until a reset while all buttons are released and heard; silence stops; then zero first."""
    chance = seeded(seed)
    silent = chance.choice((0, 300, 1000))
    together = chance.choice((200, 500))
    zero_first = chance.random() < 0.7
    trace = Trace(
        "estop", seed, silent=silent / 1000, zeroFirst=zero_first, twoHands=two_hands,
        together=together / 1000,
    )  # fmt: skip
    buttons, zeros = Switches(silent), Zeros(100)
    presses = (3, 4) if chance.random() < 0.4 else (3,)
    hands = (5, 6)
    nodes = (1, 2) if chance.random() < 0.3 else (1,)
    latched = False
    """A start is a stop by silence, so a reset is needed only after a press."""
    unsure = False
    """A reset whose edge the two readings of the page judge differently."""
    up: dict[int, tuple[int, int]] = {}
    """When a key of a reset was released: the first and the last `false` since its `true`."""
    edges: dict[int, int] = {}
    down: set[int] = set()

    def going(tick: int = 0) -> bool:
        return buttons.all_heard(trace.now - tick) and buttons.all_are(False) and not latched

    def reset(hand: int) -> None:
        nonlocal latched, unsure
        first, last = up.pop(hand, (trace.now, trace.now))
        sure, perhaps = trace.now - last > 100, trace.now - first >= 100
        if hand in down or not (buttons.all_heard(trace.now) and buttons.all_are(False)) or not perhaps:
            down.add(hand)
            return
        down.add(hand)
        edges[hand] = trace.now
        others = [other for other, at in edges.items() if other != hand and trace.now - at <= together]
        if two_hands and not any(other in down for other in others):
            return
        latched, was = False, latched
        unsure = was and (not sure or two_hands)

    for _ in range(events):
        moved, was, dues = trace.moving, trace.now, buttons.due()
        trace.wait(pause(chance, silent or 300, 80))
        if moved:
            if dues:
                trace.stopped_within(was, min(dues) + 100)
            if any(at > was for at in trace.stops):
                assert any(end <= trace.now for end in dues), trace.said("a stop, and no button is silent")
        if latched and len(buttons.heard) and trace.now - was > 110:
            assert trace.stops and trace.now - trace.stops[-1] <= 100, trace.said("stops are not repeated")
        if not going():
            zeros.stop(buttons.silence(trace.now))
        kind = chance.random()
        if kind < 0.4:
            button, pressed = chance.choice(presses), chance.random() < 0.12
            buttons.hear(button, trace.now, on=pressed)
            trace.observe("stop", boolean(pressed), button, pressed)
            if pressed:
                latched, unsure = True, False
                edges.clear()
        elif kind < 0.65:
            hand, pressed = chance.choice(hands), chance.random() < 0.5
            trace.observe("reset", boolean(pressed), hand, pressed)
            if pressed:
                reset(hand)
            else:
                down.discard(hand)
                up[hand] = (up.get(hand, (trace.now, 0))[0], trace.now)
        else:
            node, legs = chance.choice(nodes), motion(chance, 0.35)
            sure, perhaps = node in zeros.sure or not zero_first, node in zeros.perhaps or not zero_first
            trace.judge(legs, node, may=going(100) and perhaps, must=going() and sure and not unsure)
            if not going():
                zeros.stop(buttons.silence(trace.now))
            if legs == STILL and going():
                zeros.add(node)
            elif legs == STILL and going(zeros.tick):
                zeros.perhaps.add(node)
        if latched or not buttons.all_are(False):
            zeros.stop()
            assert not trace.moving or buttons.all_are(False), trace.said(
                "a button is pressed, and the base moves"
            )


def two_hands(seed: int, events: int = 80) -> None:
    """Two nodes reset within `together`, and both still hold."""
    stop_button(seed, events, two_hands=True)


def operating_mode(seed: int, events: int = 40) -> None:
    """In manual mode, and while a node is silent or unheard, the norms of velocities keep their limits."""
    chance = seeded(seed)
    silent = chance.choice((0, 300, 1000))
    v_max, w_max = chance.choice(((0.25, 0.5), (0.1, 0.2), (0.0, 0.5)))
    trace = Trace("mode", seed, silent=silent / 1000, vMax=v_max, wMax=w_max)
    switches, zeros = Switches(silent), Zeros(20)
    speakers = (3, 4) if chance.random() < 0.4 else (3,)

    def automatic(tick: int = 0) -> bool:
        return switches.all_heard(trace.now - tick) and switches.all_are(False)

    for _ in range(events):
        moved, was = not slow(trace.force, v_max, w_max), trace.now
        dues = switches.due()
        trace.wait(pause(chance, silent or 300))
        if moved and dues:
            trace.stopped_within(was, min(dues) + 20)
        if not automatic():
            zeros.stop(switches.silence(trace.now))
        if chance.random() < 0.4:
            node, manual = chance.choice(speakers), chance.random() < 0.2
            switches.hear(node, trace.now, on=manual)
            trace.observe("by", boolean(manual), node, manual)
            if not switches.all_are(False):
                zeros.stop()
            if not automatic(20):
                assert slow(trace.force, v_max, w_max), trace.said("manual mode, and the base is faster")
            continue
        legs = motion(chance)
        got = trace.command(legs, 1)
        limited = (*scaled(legs[:3], v_max), *scaled(legs[3:], w_max))
        if not automatic():
            zeros.stop(switches.silence(trace.now))
        if slow(legs, v_max, w_max) or (automatic() and 1 in zeros.sure):
            assert got == legs, trace.said(f"{legs} must pass")
        elif got != legs or not automatic(20) or 1 not in zeros.perhaps:
            assert got is not None and near(got, limited), trace.said(f"{got} is not {limited}")
        if slow(legs, v_max, w_max) and automatic():
            zeros.add(1)
        elif slow(legs, v_max, w_max) and automatic(zeros.tick):
            zeros.perhaps.add(1)
