"""The arguments and options of the commands of `rosmop`, which `rosrv monitor` shares."""

from pathlib import Path
from typing import Annotated

import typer

Files = Annotated[list[Path], typer.Argument(metavar="FILE", help="Specifications (.rv)", show_default=False)]
Folders = Annotated[
    list[Path] | None,
    typer.Option("--msg", metavar="DIR", help="A folder of message definitions (repeatable)"),
]
Bags = Annotated[
    list[Path] | None,
    typer.Option("--bag", metavar="FILE", help="A recording: a bag or an MCAP file (repeatable)"),
]
BagSets = Annotated[
    list[str] | None,
    typer.Option(
        "--bags",
        metavar="DIR",
        help="All recordings in a folder, or matching a pattern ('2026-*/*.bag') (repeatable)",
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(min=1, metavar="N", help="Processes on this machine; by default one for each processor"),
]
On = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS", help="Use a Ray cluster: ray://HEAD:PORT, or `auto` on one of its machines"
    ),
]
Resume = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Keep the results of finished recordings in a file, and skip recordings whose results it has",
    ),
]
ReportFile = Annotated[
    Path | None, typer.Option("--report", metavar="FILE", help="Also write the report of --json to a file")
]
ShowProgress = Annotated[
    bool,
    typer.Option(
        "--progress", metavar="", help="Print the progress on standard error, even if it is not a terminal"
    ),
]
Json = Annotated[
    bool, typer.Option("--json", metavar="", help="Machine-readable output, one object per line")
]
Prove = Annotated[
    bool,
    typer.Option(
        "--prove",
        metavar="",
        help="Also prove that the compiled code of each event matches its specification",
    ),
]
WhySlow = Annotated[
    bool,
    typer.Option(
        "--why-slow",
        metavar="",
        help="Also list the messages that are interpreted, not compiled, which is slower; with file, line and reason",
    ),
]
Dot = Annotated[Path | None, typer.Option(metavar="FILE", help="Draw the automata for Graphviz (.dot)")]
Svg = Annotated[Path | None, typer.Option(metavar="FILE", help="Draw the automata as a picture (.svg)")]
Output = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        metavar="FILE",
        help="File for the messages that subscribers would have received, for one recording",
    ),
]
Topics = Annotated[
    list[str] | None,
    typer.Option("--topic", metavar="PATTERN", help="Only these topics, such as /arm/* (repeatable)"),
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        metavar="FILE",
        help="File (.rv), must not exist; message definitions go into msg/ beside it",
    ),
]
HoldOut = Annotated[
    float,
    typer.Option(min=0.0, max=0.9, metavar="SHARE", help="The share of the recordings that tests the result"),
]
FailUnder = Annotated[
    float,
    typer.Option(
        min=0.0, max=100.0, metavar="PERCENT", help="Exit status 1 if less than this percentage is covered"
    ),
]
