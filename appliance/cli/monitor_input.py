"""What the monitor verbs read: specifications, and folders of message definitions."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import typer

from appliance.ros.definitions import Definitions
from appliance.ros.errors import DefinitionError
from appliance.ros.standard import standard_definitions
from appliance.rosmop.positions import Position
from appliance.rosmop.syntax.errors import SpecificationError

BESIDE = "msg"
"""The folder of definitions that is looked into beside every specification."""


def usage_error(text: str) -> typer.Exit:
    """Write what was wrong with the command line; raise the result (exit status 2)."""
    typer.echo(f"rosrv monitor: {text}", err=True)
    return typer.Exit(2)


def read_specifications(files: Sequence[Path]) -> dict[str, str]:
    """The texts of specifications by name, in the order of file names. Bytes that are no UTF-8 are half of a character
    (`surrogateescape`), which no specification may have: it is refused with all else that is wrong.
    """
    texts: dict[str, str] = {}
    for file in sorted(files, key=lambda path: (path.name, str(path))):
        try:
            raw = file.read_bytes()
        except OSError as error:
            raise usage_error(f"cannot read {file}: {error.strerror}") from error
        texts[str(file)] = raw.decode("utf-8-sig", "surrogateescape")
    return texts


def read_definitions(files: Sequence[Path], folders: Sequence[Path]) -> Definitions:
    """ROS's own definitions, those in `msg/` beside the specifications, and those of the folders.

    Later ones win. Raises `SpecificationError` for a definition that cannot be read.
    """
    for folder in folders:
        if not folder.is_dir():
            raise usage_error(f"--msg: {folder} is no folder")
    beside = dict.fromkeys(file.parent / BESIDE for file in files)
    definitions = standard_definitions()
    for folder in [*(path for path in beside if path.is_dir()), *folders]:
        definitions = definitions.extended(_definitions_in(folder))
    return definitions


def _definitions_in(folder: Path) -> Definitions:
    texts: dict[str, str] = {}
    places: dict[str, str] = {}
    for path in _definition_files(folder):
        package = path.parent.parent if path.parent.name in ("msg", "srv") else path.parent
        if package == folder.parent or path.parent == folder:
            text = f"a definition belongs into the folder of its package: {folder}/package/{path.name}"
            raise SpecificationError.at(Position(str(path), 1, 1), text)
        name = f"{package.name}/{path.name}"
        places[name] = places[name.rsplit(".", 1)[0]] = str(path)
        texts[name] = _text_of(path)
    try:
        return Definitions.from_files(texts)
    except DefinitionError as error:
        place = places.get(error.source, str(folder / error.source))
        raise SpecificationError.at(Position(place, max(error.line, 1), 1), error.text) from None


def _definition_files(folder: Path) -> Iterable[Path]:
    return sorted(path for path in folder.rglob("*") if path.suffix in (".msg", ".srv") and path.is_file())


def _text_of(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="surrogateescape")
    except OSError as error:
        raise usage_error(f"cannot read {path}: {error.strerror}") from error
