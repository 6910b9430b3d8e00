"""Read `Settings` from file, environment and flags; later sources override earlier ones.

    1. defaults; for the section `fleet` those of `rosrv fleet join`, unless a source names a collector (`stored_in`)
    2. `appliance.yaml` (`--config`, else `ROSRV_CONFIG`, else the one in the working directory, if any)
    3. the environment: `ROSRV_LISTEN`, and `ROSRV_LIMITS__BODY_BYTES` for the key `body_bytes` under `limits`
    4. flags

With a file, its relative paths and relative defaults are below the file's folder; all other paths are below the
working directory.
"""

import dataclasses
import difflib
import functools
import re
import sys
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter, ValidationError

from appliance.base.input_files import read_given_text
from appliance.base.user_errors import UserError
from appliance.base.validation_messages import must_be, not_yaml
from appliance.configuration.settings import SECTIONS, Settings

if typing.TYPE_CHECKING:
    from _typeshed import DataclassInstance
    from pydantic_core import ErrorDetails

DEFAULT_FILE = Path("appliance.yaml")
_DEFAULT_STATE = Settings.state
_PREFIX = "ROSRV_"
_NOT_CONFIGURATION = {"ROSRV_CONFIG", "ROSRV_TOKEN", "ROSRV_API_URL", "ROSRV_API_CA"}
_ADDRESS = re.compile(r"\[[^]]*+\]:\d++")
# Variables that Kubernetes and container links set for a service named `rosrv`.
_SERVICE_LINK = re.compile(r"ROSRV_(SERVICE_(HOST|PORT.*+)|PORT|PORT_\d++_.*+|ENV_.*+)")


def _paths_of(section: type) -> Iterator[tuple[str, ...]]:
    for name, annotation in typing.get_type_hints(section).items():
        if Path in (annotation, *typing.get_args(annotation)):
            yield (name,)
        elif dataclasses.is_dataclass(annotation) and isinstance(annotation, type):
            yield from ((name, *path) for path in _paths_of(annotation))


_PATH_KEYS = (
    ("policy",), ("monitors",), ("state",), ("hosts",),
    ("ipsec", "ca_passphrase_file"),
    *((*kind.place.split("."), *path) for kind in SECTIONS for path in _paths_of(kind)),
)  # fmt: skip
KeyPath = tuple[str | int, ...]
_SHORT_NAMES: dict[str, KeyPath] = {
    "ROSRV_CA_PASSPHRASE_FILE": ("ipsec", "ca_passphrase_file"),
    "ROSRV_RELAY": ("relaying",),  # like --relay; a table sets the section `relay`
}
_FLAGS = {"relaying": "--relay"}  # `relay` is a section of the file
_Section = typing.TypeVar("_Section", bound="DataclassInstance")


@dataclass(frozen=True)
class Mistake:
    """A mistake with its location: `appliance.yaml:12`, `ROSRV_LISTEN`, `--listen`."""

    place: str
    text: str

    def __str__(self) -> str:
        return f"{self.place}: {self.text}"


class ConfigError(UserError):
    """The configuration has mistakes."""

    def __init__(self, mistakes: list[Mistake]) -> None:
        self.mistakes = sorted(mistakes, key=_line_of)
        super().__init__("\n".join(map(str, self.mistakes)))


def _line_of(mistake: Mistake) -> int:
    line = mistake.place.rpartition(":")[2]
    return int(line) if line.isdigit() else sys.maxsize


def json_schema() -> dict[str, object]:
    return _reader().json_schema()


def read(values: object) -> Settings:
    """Return the settings in the values. Raises `pydantic.ValidationError`."""
    return _reader().validate_python(values)


def plain(settings: Settings) -> dict[str, object]:
    found: dict[str, object] = _reader().dump_python(settings, mode="json")
    return found


@functools.cache
def _reader() -> TypeAdapter[Settings]:
    return TypeAdapter(Settings)


def resolve(file: Path | None, environment: Mapping[str, str], flags: Mapping[str, object]) -> Settings:
    """Return the settings from all sources; a flag whose value is None was not given. Raises `ConfigError`."""
    gathered = _Gathered()
    chosen = _choose_file(file, environment)
    if chosen is not None:
        gathered.add_file(chosen)
    gathered.add_environment(environment)
    gathered.add_flags(flags)
    return gathered.settings()


def _choose_file(file: Path | None, environment: Mapping[str, str]) -> Path | None:
    if file is not None:
        return file
    if environment.get("ROSRV_CONFIG"):
        return Path(environment["ROSRV_CONFIG"])
    return DEFAULT_FILE if DEFAULT_FILE.exists() else None


class _Gathered:
    """The values read so far, with the location of each key, and all mistakes."""

    def __init__(self) -> None:
        self._values: dict[str | int, Any] = {}
        self._places: dict[KeyPath, str] = {}
        self._mistakes: list[Mistake] = []

    def add_file(self, file: Path) -> None:
        try:
            text = read_given_text(file)
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
            raise ConfigError([Mistake(str(file), f"cannot be read: {reason}")]) from error
        try:
            node = yaml.compose(text, Loader=yaml.SafeLoader)
            self._note_places(file, node, ())
            values = yaml.safe_load(text)
        except yaml.MarkedYAMLError as error:
            line = error.problem_mark.line + 1 if error.problem_mark else 1
            raise ConfigError([Mistake(f"{file}:{line}", not_yaml(error.problem))]) from error
        except RecursionError as error:
            raise ConfigError([Mistake(str(file), "is nested too deeply, or refers to itself")]) from error
        except (yaml.YAMLError, ValueError) as error:
            raise ConfigError([Mistake(str(file), not_yaml(error))]) from error
        values = {} if values is None else values
        if not isinstance(values, dict):
            raise ConfigError([Mistake(f"{file}:1", "must have lines of the form `key: value`")])
        for path in _PATH_KEYS:
            _resolve_path(values, path, file.absolute().parent)
        for field in dataclasses.fields(Settings):
            if isinstance(field.default, Path):  # an absolute default stays as it is
                values.setdefault(field.name, str(file.absolute().parent / field.default))
        self._values = values

    def add_environment(self, environment: Mapping[str, str]) -> None:
        for name in sorted(environment):
            text = environment[name]
            if not name.startswith(_PREFIX) or name in _NOT_CONFIGURATION:
                continue
            if _SERVICE_LINK.fullmatch(name) or (
                name == "ROSRV_NAME" and text.startswith("/")
            ):  # /ROBOT/rosrv
                continue
            path: KeyPath = tuple(part.lower() for part in name.removeprefix(_PREFIX).split("__"))
            value: object = text
            if text == "null" or (text.startswith(("[", "{")) and not _ADDRESS.fullmatch(text)):
                try:
                    value = yaml.safe_load(text)
                except yaml.YAMLError as error:
                    problem = error.problem if isinstance(error, yaml.MarkedYAMLError) else error
                    self._mistakes.append(Mistake(name, not_yaml(problem)))
                    continue
            if name in _SHORT_NAMES and not isinstance(value, dict):
                path = _SHORT_NAMES[name]
            self._set(path, value, name)

    def add_flags(self, flags: Mapping[str, object]) -> None:
        for key, value in flags.items():
            if value is not None:
                self._set((key,), value, _FLAGS.get(key, "--" + key.replace("_", "-")))

    def add_stored(self) -> None:
        state = self._values.get("state", _DEFAULT_STATE)
        for kind in SECTIONS:
            given = self._values.get(kind.place, {})
            if not kind.stored_in or not isinstance(state, str | Path) or not isinstance(given, dict):
                continue
            file = Path(state) / kind.stored_in
            try:
                section = kind.with_stored(Path(state), given)
            except (OSError, ValueError) as error:
                reason = error.strerror if isinstance(error, OSError) else error
                self._mistakes.append(Mistake(str(file), f"cannot be used: {reason}"))
                continue
            if section != given:
                self._values[kind.place] = section
                self._places.setdefault((kind.place,), str(file))

    def settings(self) -> Settings:
        self.add_stored()
        try:
            settings = read(self._values)
        except ValidationError as error:
            for detail in error.errors(include_url=False):
                self._mistakes.append(self._mistake(detail))
            raise ConfigError(self._mistakes) from error
        if self._mistakes:
            raise ConfigError(self._mistakes)
        return _with_absolute_paths(settings)

    def _set(self, path: KeyPath, value: object, place: str) -> None:
        table: dict[str | int, Any] = self._values
        for key in path[:-1]:
            if not isinstance(table.get(key), dict):
                table[key] = {}
            table = table[key]
        table[path[-1]] = value
        # The new value replaces the whole subtree, so known locations inside it are outdated.
        for older in [known for known in self._places if known[: len(path)] == path]:
            del self._places[older]
        self._places[path] = place

    def _note_places(self, file: Path, node: yaml.Node | None, path: KeyPath) -> None:
        if isinstance(node, yaml.MappingNode):
            seen: set[str] = set()
            for key, value in node.value:
                place = f"{file}:{key.start_mark.line + 1}"
                name = str(key.value)
                if name in seen:
                    self._mistakes.append(Mistake(place, f"{_dotted_path((*path, name))} is given twice"))
                seen.add(name)
                self._places[*path, name] = place
                self._note_places(file, value, (*path, name))
        elif isinstance(node, yaml.SequenceNode):
            for index, value in enumerate(node.value):
                self._places[*path, index] = f"{file}:{value.start_mark.line + 1}"
                self._note_places(file, value, (*path, index))

    def _mistake(self, error: "ErrorDetails") -> Mistake:
        kind, path, context = error["type"], error["loc"], error.get("ctx")
        if kind == "invalid_key":
            path = (*path[:-1], str(path[-1]))
        place = self._place_of(path)
        if path[-1:] == ("[key]",):  # pydantic's mark: not the value of a mapping is wrong, but its key
            *section, key, _mark = path
            wanted = context["error"] if kind == "value_error" and context else f"must be {must_be(error)}"
            return Mistake(place, f"{_about(tuple(section), place)}the key {key!r}: {wanted}")
        if kind in ("unexpected_keyword_argument", "invalid_key"):
            return Mistake(place, _unknown_key(path))
        if kind == "missing":
            return Mistake(place, f"{_dotted_path(path)} must be given")
        if kind == "value_error" and context:  # our own message
            return Mistake(place, f"{_about(path, place)}{context['error']}")
        wanted = must_be(error)
        return Mistake(place, f"{_about(path, place)}must be {wanted}, not {self._value_at(path)!r}")

    def _place_of(self, path: KeyPath) -> str:
        for length in range(len(path), 0, -1):
            if path[:length] in self._places:
                return self._places[path[:length]]
        # A table instead of a plain value: use the location of its first key.
        return next(
            (place for known, place in self._places.items() if known[: len(path)] == path), "configuration"
        )

    def _value_at(self, path: KeyPath) -> object:
        value: Any = self._values
        for key in path:
            try:
                value = value[key]
            except (KeyError, IndexError, TypeError):
                break
        return str(value) if isinstance(value, Path) else value


def _about(path: KeyPath, place: str) -> str:
    return "" if not path or (place.startswith("--") and len(path) == 1) else f"{_dotted_path(path)}: "


def _dotted_path(path: KeyPath) -> str:
    return ".".join(map(str, path))


_REMOVED = {
    "availability": "answers of one of two appliances always wait for the standby; remove the section"
}


def _unknown_key(path: KeyPath) -> str:
    if len(path) == 1 and path[0] in _REMOVED:
        return f"{path[0]} is not a section any more: {_REMOVED[path[0]]}"
    known = sorted(_keys_at(Settings, path[:-1]))
    near = functools.partial(difflib.get_close_matches, str(path[-1]), known, n=1)
    elsewhere = [
        _dotted_path(key) for key in _all_keys(Settings, ()) if key[-1] == path[-1]
    ]  # on another level
    nearest = near(cutoff=0.75) or elsewhere[:1] or near(cutoff=0.5)
    advice = f"did you mean {nearest[0]}?" if nearest else f"known here: {', '.join(known)}"
    return f"unknown key {_dotted_path(path)}: {advice}"


def _with_absolute_paths(section: _Section) -> _Section:
    changes: dict[str, object] = {}
    for key in (field.name for field in dataclasses.fields(section)):
        value = getattr(section, key)
        if isinstance(value, Path):
            changes[key] = value.absolute()
        elif (
            dataclasses.is_dataclass(value)
            and not isinstance(value, type)
            and (absolute := _with_absolute_paths(value)) != value
        ):
            changes[key] = absolute
    return dataclasses.replace(section, **changes) if changes else section


def _resolve_path(values: dict[str, Any], path: tuple[str, ...], folder: Path) -> None:
    *sections, key = path
    for section in sections:
        below = values.get(section)
        if not isinstance(below, dict):
            return
        values = below
    if isinstance(values.get(key), str):
        values[key] = str(folder / values[key])


def _keys_at(section: type, path: KeyPath) -> set[str]:
    for key in path:
        if not isinstance(key, int):
            section = _section_of(typing.get_type_hints(section)[key]) or section
    return set(typing.get_type_hints(section))


def _all_keys(section: type, path: KeyPath) -> Iterator[KeyPath]:
    for name, annotation in typing.get_type_hints(section).items():
        yield (*path, name)
        below = _section_of(annotation)
        if below is not None:
            yield from _all_keys(below, (*path, name))


def _section_of(annotation: object) -> type | None:
    inner = typing.get_args(annotation)
    if inner:
        return next(filter(None, map(_section_of, inner)), None)
    return annotation if isinstance(annotation, type) and dataclasses.is_dataclass(annotation) else None
