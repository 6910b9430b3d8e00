"""The answers of control about guards."""

from typing import Annotated

import msgspec

from appliance.channel.answers.field_docs import Moment, RevisionNumber, doc
from appliance.channel.answers.monitor_answers import GivenState, Tag


class PresetParameter(msgspec.Struct, frozen=True):
    """A parameter of a preset. `least` and `most` are empty for values that are not numbers."""

    name: Annotated[str, doc("its name in the text")]
    kind: Annotated[str, doc("`int`, `double`, `bool`, `corners`, `joints`, `time` or `hosts`")]
    default: Annotated[str, doc("the value in the preset")]
    unit: Annotated[str, doc("the unit of its values, or empty if they have none")]
    least: Annotated[str, doc("the least value, or empty if it is not a number")]
    most: Annotated[str, doc("the greatest value, or empty if it is not a number")]
    what: Annotated[str, doc("its meaning, for a person")]
    loads: Annotated[bool, doc("it is in the guard's file: a change loads the file, and for admins only")]
    safe: Annotated[
        str, doc("the values that the standard asks for, such as `>= 1.6`, or empty if it asks for none")
    ] = ""


class PresetRow(msgspec.Struct, frozen=True):
    """A preset: its topics with their defaults, and the message types of each topic that has several."""

    preset: Annotated[str, doc("the name of the preset")]
    version: Annotated[int, doc("changes with its text")]
    what: Annotated[str, doc("its effect, for a person")]
    topics: Annotated[dict[str, str], doc("the topics that are given to it, with their defaults")]
    types: Annotated[dict[str, list[str]], doc("message types of each topic that has several")]
    parameters: Annotated[list[PresetParameter], doc("the values that operators set")]


class LastStop(msgspec.Struct, frozen=True):
    """The last stop of a guard since control started: it sent its safe message, or put it in the place of commands."""

    since: Annotated[Moment, doc("its first action, in seconds since the epoch")]
    until: Annotated[Moment | None, doc("its last action, or null while it goes on")]
    actions: Annotated[int, doc("the safe messages so far")]
    cause: Annotated[
        str,
        doc(
            "why it stops now, or if it has ended, why it began: a sentence of the guard with the values and limits"
            " that it compared, a fault, or why it cannot judge"
        ),
    ]
    host: Annotated[str, doc("the host of the message that led to it, or empty if a timer did")]
    node: Annotated[str, doc("the node of that message")]
    record: Annotated[str, doc("the audit record `stop begun`")]
    publisher_host: Annotated[
        str,
        doc(
            "if a timer led to it: the host of the topic's only publisher, or of the last one that has ended; empty if"
            " there were several"
        ),
    ] = ""
    publisher_node: Annotated[str, doc("the node of that publisher")] = ""


class GuardTimes(msgspec.Struct, frozen=True):
    """How late a guard has acted, over restarts, since it was first measured with this limit.

    Measured are its ticks, from when they are due until their messages are written to the sockets, and the messages on
    its topics that passed, from their receipt until then.
    """

    since: Annotated[Moment, doc("the first measurement, in seconds since the epoch")]
    seconds: Annotated[float, doc("how long it was in force since then, and measured")]
    timed: Annotated[int, doc("ticks and messages")]
    late: Annotated[
        int, doc("those beyond the limit, and times when its relay was busy or stopped for longer")
    ]
    latest: Annotated[float, doc("the longest delay, in seconds")]
    limit: Annotated[float, doc("the limit in seconds, `relay.late`")]


class StopReached(msgspec.Struct, frozen=True):
    """A subscriber of the command to which a proof test wrote the stop, or a driver that has no connection.

    The times are seconds from the fault in real time, or null if it took longer than a second. Whether the node read
    the stop, or obeyed, is not seen.
    """

    node: Annotated[str, doc("the subscriber")]
    host: Annotated[str, doc("its host")]
    driver: Annotated[bool, doc("it carries out the command; others only listen")]
    accepted: Annotated[
        float | None, doc("the seconds until the socket of its connection had accepted all bytes")
    ]
    acknowledged: Annotated[
        float | None, doc("the seconds until the TCP of its host had acknowledged all bytes")
    ]


class ProofTest(msgspec.Struct, frozen=True):
    """The proof test of a guard: a fault on a copy of it, and the way of its stop to the driver."""

    at: Annotated[Moment, doc("when it was tested, in seconds since the epoch")]
    digest: Annotated[str, doc("the digest of the guard that was tested")]
    stimulus: Annotated[str, doc("the fault, for a person")]
    outcome: Annotated[
        str,
        doc(
            "`stopped`, `limited`, `dropped` or `withheld`: what the copy did at the fault; `passed`: it did nothing;"
            " `undecided`: the honest motion before the fault did not pass either"
        ),
    ]
    cause: Annotated[str, doc("the cause that the copy printed, or empty")]
    after: Annotated[float, doc("seconds of the copy's own time from the fault to that, such as `silent`")]
    seconds: Annotated[float, doc("seconds of real time in which the copy judged the messages of the fault")]
    reached: Annotated[
        list[StopReached],
        doc("the subscribers to which the stop was written, and the drivers without a connection"),
    ]
    not_sent: Annotated[str, doc("why no stop was sent to the driver, or empty")]
    who: Annotated[str, doc("who ordered it")]

    def in_words(self) -> str:
        """Return the fault and what the copy did, as a sentence."""
        match self.outcome:
            case "passed":
                did = "the copy did not act"
            case "undecided":
                did = "not decided: the copy also stopped the honest motion before it"
            case _:
                did = f"the copy {self.outcome} {_ACTS_ON[self.outcome]} {self.after:.2f} s later"
                did += f", after {self.seconds * 1e3:.1f} ms of judging"
        return f"{self.stimulus}: {did}{f' ({self.cause})' if self.cause else ''}"

    @property
    def proved(self) -> bool:
        """Whether the copy acted, and the stop was acknowledged by each driver, unless none was to be sent."""
        drivers = [one for one in self.reached if one.driver]
        arrived = bool(drivers) and all(driver.acknowledged is not None for driver in drivers)
        return self.outcome in _ACTS_ON and (arrived or bool(self.not_sent))


_ACTS_ON = {
    "stopped": "the motion",
    "limited": "the command",
    "dropped": "the command",
    "withheld": "the topic",
}


class GuardRow(msgspec.Struct, frozen=True):
    """A loaded guard."""

    name: Annotated[str, doc("its name, which is that of its monitor")]
    preset: Annotated[str, doc("the preset that it was made from")]
    file: Annotated[str, doc("the specification file that defines it")]
    state: Annotated[
        str,
        doc(
            "`free`: it changed nothing in the last 2 seconds; `stopping`: it did; `withholding`: it withholds its"
            " topic from hosts; `holding`: it cannot judge, and waits for an operator; `shadow`: it only records;"
            " `off`: it is disabled; `broken`: its file has an error, so it does nothing"
        ),
    ]
    topics: Annotated[dict[str, str], doc("the topics that are given to it, by name")]
    types: Annotated[dict[str, str], doc("their message types, where the preset has several")]
    given: Annotated[list[GivenState], doc("constants and topics that are given to it")]
    loads: Annotated[
        dict[str, str], doc("values in its text: a polygon, limits of joints, a deadline, hosts")
    ]
    stops: Annotated[int, doc("messages that it changed or dropped; in shadow mode: that it would have")]
    why_held: Annotated[str, doc("why it holds its topics, if it does")] = ""
    confirm_by: Annotated[
        Moment | None, doc("when it returns to shadow mode unless confirmed, or null if it stays")
    ] = None
    off_until: Annotated[Moment | None, doc("when it is enabled again automatically, or null if never")] = (
        None
    )
    last_stop: Annotated[LastStop | None, doc("its last stop, or null if there was none")] = None
    version: Annotated[int, doc("the version of the preset in its text")] = 0
    origin: Annotated[
        str,
        doc(
            "`current`: the text of the preset, with its topics and values; `older`: that of a released version, which"
            " `rosrv guard upgrade` replaces; `changed`: any other text"
        ),
    ] = "current"
    below: Annotated[
        list[str], doc("its values that are less safe than the standard asks for, each with the safe ones")
    ] = []
    awaits: Annotated[
        str,
        doc(
            "the nodes, with their topics, that it must hear before a motion passes, or empty if there are none"
        ),
    ] = ""
    afresh: Annotated[
        str,
        doc(
            "how it would begin with a new state directory: `on`, `shadow` or `off`, as its file or the setting"
            " `enable` says, or `absent`: its file is not in the folder of specifications"
        ),
    ] = "on"
    digest: Annotated[
        str, doc("binds its preset, text and values: the same digest is the same guard, with the same values")
    ] = ""
    times: Annotated[GuardTimes | None, doc("how late it has acted, or null if it was not in force yet")] = (
        None
    )
    tested: Annotated[ProofTest | None, doc("its last proof test, or null if there was none")] = None
    error: Annotated[str, doc("the error of its file, because of which it does nothing; else empty")] = ""


class GuardList(msgspec.Struct, frozen=True):
    """The presets, and the guards that are loaded, in the order in which they see messages."""

    revision: RevisionNumber
    tag: Tag
    presets: Annotated[list[PresetRow], doc("all presets")]
    guards: Annotated[list[GuardRow], doc("the loaded guards, in the order in which they see messages")]
    warnings: Annotated[
        list[str],
        doc(
            "monitors that were guards before 0.4, bases on other machines, and drivers that command themselves"
        ),
    ] = []


class GuardPlan(msgspec.Struct, frozen=True):
    """The effects of a new guard, of new values or of `enforce`; nothing has changed."""

    revision: RevisionNumber
    tag: Tag
    name: Annotated[str, doc("the guard")]
    file: Annotated[str, doc("the specification file that would be loaded, or empty if there is none")]
    text: Annotated[str, doc("its text")]
    begins: Annotated[bool, doc("the guard would begin in its initial state")]
    shadow: Annotated[bool, doc("it would be in shadow mode")]
    changed: Annotated[dict[str, list[str]], doc("values before and after, by parameter")]
    acts: Annotated[dict[str, str], doc("the topics on which it would act or look, by name")]
    stops: Annotated[int, doc("messages that it has stopped, or in shadow mode would have stopped, so far")]
    warnings: Annotated[list[str], doc("warnings that the change would give")]
    refused: Annotated[
        list[str], doc("why the change would be refused, for example because topics would be held")
    ]
    off: Annotated[bool, doc("it is disabled, and would stay so")] = False


class Suggestion(msgspec.Struct, frozen=True):
    """A guard that fits the graph. The values in `measured` come from present rates; check all others."""

    preset: Annotated[str, doc("the preset")]
    name: Annotated[str, doc("the name of the guard")]
    what: Annotated[str, doc("its effect, for a person")]
    topics: Annotated[dict[str, str], doc("its topics, by the names that the preset has for them")]
    measured: Annotated[dict[str, str], doc("values from the present rates of topics, by parameter")]
    values: Annotated[dict[str, str], doc("other values that fit the topics, by parameter")]
    command: Annotated[str, doc("the command line that makes it")]
    others: Annotated[dict[str, list[str]], doc("alternatives, by the names of its topics")] = {}


class LoadedSuggestion(msgspec.Struct, frozen=True):
    """A guard that would be proposed if it were not loaded."""

    name: Annotated[str, doc("the guard")]
    preset: Annotated[str, doc("its preset")]
    topics: Annotated[dict[str, str], doc("its topics, by the names that the preset has for them")]
    state: Annotated[str, doc("its state, as in `rosrv guard list`")] = "free"


class Suggestions(msgspec.Struct, frozen=True):
    """Guards for each topic that commands a base or an arm."""

    suggestions: Annotated[list[Suggestion], doc("the proposed guards")]
    loaded: Annotated[list[LoadedSuggestion], doc("guards that are loaded, so not proposed")] = []
    left_out: Annotated[list[str], doc("what is ambiguous or cannot be guarded, as sentences")] = []
    not_protected: Annotated[
        list[str], doc("what neither these guards nor those in use protect, as sentences; never empty")
    ] = []
    unguarded: Annotated[
        list[str], doc("what no guard in force protects now, as sentences without advice; never empty")
    ] = []


class DriverCheck(msgspec.Struct, frozen=True):
    """The present check of a robot's driver, or the last one since control started."""

    command: Annotated[str, doc("the topic whose motions are withheld, or empty if there was no check")] = ""
    by: Annotated[str, doc("the topic that shows how the base moves")] = ""
    outcome: Annotated[
        str,
        doc(
            "empty while it is under way; `stopped`: the driver stopped the base; `moving`: it did not, in time;"
            " not measured: `idle`: no slow drive; `ended`: a stop command came; `silent`: the odometry was silent;"
            " `interrupted`: a process ended, or the client no longer asked"
        ),
    ] = ""
    seconds: Annotated[
        float | None, doc("from the last command that the base got to the outcome; `idle`: that it waited")
    ] = None
    text: Annotated[str, doc("the outcome, for a person")] = ""
