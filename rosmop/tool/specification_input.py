"""Read specifications and folders of message definitions."""

import os
import shlex
from collections.abc import Sequence
from pathlib import Path

from rosmop.batch.replay_job import Specifications
from rosmop.check.givens import with_topics
from rosmop.check.sources import compiled_from
from rosmop.form.compiled import Compiled
from rosmop.form.findings import Position, SpecificationError
from rosmop.text import tree
from rosmop.text.parser import parse
from rosmop.tool.command_context import CommandContext
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.standard import standard_definitions

__all__ = [
    "BESIDE", "Specifications", "definition_folders", "definition_texts", "load", "read_definitions",
    "read_for_recordings", "read_specifications", "topics_of",
]  # fmt: skip

BESIDE = "msg"
_RECORDINGS = (b"#ROSBAG ", b"\x89MCAP")


def load(
    program: CommandContext, files: list[Path], folders: list[Path], recorded: Definitions | None = None
) -> Compiled:
    """Compile the files. `recorded` applies to types that no file defines. Raises `SpecificationError`."""
    definitions = read_definitions(program, files, folders)
    if recorded is not None:
        definitions = recorded.merge(definitions)
    return compiled_from(read_specifications(program, files), definitions)


def read_specifications(program: CommandContext, files: Sequence[Path]) -> dict[str, str]:
    """Return texts by name, in the order of file names.

    In texts, bytes outside UTF-8 become surrogates, which the parser rejects with their position.
    """
    texts: dict[str, str] = {}
    for file in sorted(files, key=lambda path: (path.name, str(path))):
        try:
            raw = program.read(file)
        except OSError as error:
            raise program.usage_error(f"cannot read {file}: {error.strerror}") from error
        if raw.startswith(_RECORDINGS):
            raise program.usage_error(
                f"{file} is a recording, not a specification: use --bag {shlex.quote(str(file))}"
            )
        name = os.fsencode(file).decode("utf-8", "backslashreplace")
        texts[name] = raw.decode("utf-8-sig", "surrogateescape")
    return texts


def topics_of(specifications: Specifications) -> dict[str, str]:
    chosen, topics = specifications.chosen, specifications.topics
    return {
        event.trigger.topic: event.trigger.type
        for name, text in specifications.texts.items()
        for specification in parse(text, name).specifications
        if chosen in (None, specification.name)
        for event in with_topics(specification, topics.get(specification.name, {})).events
        if isinstance(event.trigger, tree.MessageTrigger) and event.trigger.part is None
    }


def read_definitions(program: CommandContext, files: Sequence[Path], folders: Sequence[Path]) -> Definitions:
    """Return the definitions of ROS, of `msg/` beside the specifications, and of the folders.

    Later definitions replace earlier ones. Raises `SpecificationError` for a definition that cannot be read.
    """
    definitions = standard_definitions()
    for folder in definition_folders(program, files, folders):
        texts, places = definition_texts(program, folder)
        try:
            definitions = definitions.merge(Definitions.from_files(texts))
        except DefinitionError as error:
            place = places.get(error.source, str(folder / error.source))
            raise SpecificationError.at(Position(place, max(error.line, 1), 1), error.text) from None
    return definitions


def read_for_recordings(
    program: CommandContext, files: Sequence[Path], folders: Sequence[Path]
) -> Specifications:
    """Return specifications for workers to compile, without the definitions of ROS.

    Raises `SpecificationError` for an invalid text or definition.
    """
    read_definitions(program, files, folders)
    definitions: dict[str, str] = {}
    for folder in definition_folders(program, files, folders):
        definitions |= definition_texts(program, folder)[0]
    # Their comments may have other encodings, which do not matter.
    escaped = {
        name: text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
        for name, text in definitions.items()
    }
    texts = read_specifications(program, files)
    for name, text in texts.items():
        parse(text, name)
    return Specifications(texts, escaped)


def definition_folders(program: CommandContext, files: Sequence[Path], folders: Sequence[Path]) -> list[Path]:
    for folder in folders:
        if not folder.is_dir():
            raise program.usage_error(f"--msg: {folder} is not a folder")
    beside = dict.fromkeys(file.parent / BESIDE for file in files)
    return [*(path for path in beside if path.is_dir()), *folders]


def definition_texts(program: CommandContext, folder: Path) -> tuple[dict[str, str], dict[str, str]]:
    texts: dict[str, str] = {}
    places: dict[str, str] = {}

    def refuse(error: OSError) -> None:
        raise program.usage_error(f"cannot read the folder {error.filename}: {error.strerror}") from error

    # `rglob` would take a folder that may not be read for an empty one.
    found = (
        Path(place, name) for place, _folders, names in os.walk(folder, onerror=refuse) for name in names
    )
    for path in sorted(path for path in found if path.suffix in (".msg", ".srv") and path.is_file()):
        package = path.parent.parent if path.parent.name in ("msg", "srv") else path.parent
        if package == folder.parent or path.parent == folder:
            text = f"a definition belongs in the folder of its package: {folder}/package/{path.name}"
            raise SpecificationError.at(Position(str(path), 1, 1), text)
        name = f"{package.name}/{path.name}"
        places[name] = places[name.rsplit(".", 1)[0]] = str(path)
        texts[name] = _text_of(program, path)
    return texts, places


def _text_of(program: CommandContext, path: Path) -> str:
    try:
        return program.read_text(path)
    except OSError as error:
        raise program.usage_error(f"cannot read {path}: {error.strerror}") from error
