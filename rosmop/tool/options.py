"""The arguments and options that `rosmop` and `rosrv monitor` have in common."""

from pathlib import Path
from typing import Annotated

import typer

Files = Annotated[
    list[Path], typer.Argument(metavar="FILE…", help="Specifications (.rv)", show_default=False)
]
Folders = Annotated[
    list[Path] | None,
    typer.Option("--msg", metavar="DIR", help="A folder of message definitions (repeatable)"),
]
Bags = Annotated[
    list[Path], typer.Option("--bag", metavar="FILE", help="A recording (repeatable)", show_default=False)
]
Json = Annotated[bool, typer.Option("--json", help="Machine-readable output, one object per line")]
Prove = Annotated[
    bool,
    typer.Option("--prove", help="Also prove that the relay's code of each event does what the event means"),
]
Dot = Annotated[Path | None, typer.Option(metavar="FILE", help="Draw the automata for Graphviz")]
Svg = Annotated[Path | None, typer.Option(metavar="FILE", help="Draw the automata as a picture")]
Bag = Annotated[Path, typer.Option(metavar="FILE", help="The recording", show_default=False)]
Output = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Write what subscribers would have received")
]
Topics = Annotated[
    list[str] | None,
    typer.Option("--topic", metavar="PATTERN", help="Only such topics, as /arm/* (repeatable)"),
]
Out = Annotated[
    Path | None,
    typer.Option(metavar="FILE.rv", help="Write it here (must not exist), definitions into msg/ beside it"),
]
HoldOut = Annotated[
    float, typer.Option(min=0.0, max=0.9, help="The share of the recordings that is its test")
]
FailUnder = Annotated[
    float, typer.Option(min=0.0, max=100.0, metavar="PERCENT", help="Exit status 1 below it")
]
