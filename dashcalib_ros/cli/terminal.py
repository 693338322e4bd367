"""stdout for results, stderr for progress, warnings and errors; plain text in a pipe."""
from __future__ import annotations

import io
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from types import TracebackType

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
)

from dashcalib_ros.errors import OutputError
from dashcalib_ros.standard_streams import write_stderr, write_stdout

PIPE_WIDTH = 100  # columns where there is no terminal
STEPS = 1000  # a stage's fraction is shown in thousandths


def show(renderable: RenderableType) -> None:
    """Print a result on stdout. Raises OutputError where it is closed or full."""
    terminal = sys.stdout is not None and sys.stdout.isatty()
    text = io.StringIO()
    console = Console(file=text, force_terminal=terminal, highlight=False,
                      width=None if terminal else PIPE_WIDTH,
                      color_system='auto' if terminal else None)
    console.print(renderable)
    lines = text.getvalue().splitlines()
    show_text('\n'.join(line.rstrip() for line in lines))


def show_text(text: str) -> None:
    """Print text on stdout. Raises OutputError where it is closed or full."""
    write_stdout(text)


@contextmanager
def summary_of_files() -> Iterator[None]:
    """Make an unusable stdout only a warning: the results shown inside are in files already."""
    try:
        yield
    except OutputError as error:
        warn([str(error)])


def warn(lines: Iterable[str]) -> None:
    """Print warnings on stderr, one line each."""
    for line in lines:
        write_stderr(f'dashcalib: warning: {" ".join(line.split())}')


class Stages:
    """The progress of one command, a stage at a time; nothing is shown in a pipe."""

    def __init__(self) -> None:
        console = Console(stderr=True)
        self._progress = Progress(
            SpinnerColumn(), TextColumn('{task.description}', markup=False), BarColumn(),
            TaskProgressColumn(), TimeElapsedColumn(), console=console, transient=True,
            disable=not console.is_terminal)
        self._stage = ''
        self._task: TaskID | None = None

    def __enter__(self) -> Stages:
        """Begin to draw."""
        self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        """Remove the drawing."""
        self._progress.stop()

    def show(self, stage: str, fraction: float | None = None, note: str = '') -> None:
        """Show a stage at fraction 0..1 (None: unknown), and a note beside its name."""
        if stage != self._stage or self._task is None:
            if self._task is not None:
                self._progress.remove_task(self._task)
            self._task = self._progress.add_task(stage, total=None)
            self._stage = stage
        self._progress.update(
            self._task, description=f'{stage}: {note}' if note else stage,
            total=None if fraction is None else STEPS,
            completed=0 if fraction is None else STEPS * min(max(fraction, 0.0), 1.0))
