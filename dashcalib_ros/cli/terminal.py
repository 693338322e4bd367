# SPDX-License-Identifier: Apache-2.0
"""stdout for results, stderr for progress, warnings and errors; plain text in a pipe.

No colours are used if NO_COLOR is set.
"""
from __future__ import annotations

import io
import json
import signal
import sys
import time
from collections.abc import Iterable
from contextlib import AbstractContextManager
from types import TracebackType
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    Task,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
)
from rich.progress_bar import ProgressBar

from dashcalib_ros.cli.program import handling
from dashcalib_ros.errors import Notice, OutputError, visible
from dashcalib_ros.session import Observer
from dashcalib_ros.standard_streams import write_stderr, write_stdout

PIPE_WIDTH = 80  # columns where there is no terminal
EVERY_S = 10.0  # between two lines of progress, where there is no terminal
STEPS = 1000  # a stage's fraction is shown in thousandths
STILL_S = 2.0  # a bar that stands longer pulses


def show(renderable: RenderableType, to_stderr: bool = False) -> None:
    """Print on stdout, or on stderr. Raises OutputError where stdout is closed or full."""
    stream = sys.stderr if to_stderr else sys.stdout
    terminal = stream is not None and stream.isatty()
    text = io.StringIO()
    console = Console(file=text, force_terminal=terminal, highlight=False,
                      width=None if terminal else PIPE_WIDTH,
                      color_system='auto' if terminal else None)
    console.print(renderable)
    plain = '\n'.join(line.rstrip() for line in text.getvalue().splitlines())
    (write_stderr if to_stderr else write_stdout)(plain, styled=bool(terminal))


def print_json(values: Any) -> None:
    """Print plain values on stdout. Raises OutputError where it is closed or full."""
    write_stdout(json.dumps(values, indent=2, allow_nan=False))


class Screen:
    """Shows a summary of results that are in files already: an unusable stdout is a warning only.

    quiet: nothing is shown. to_stderr: stdout is used for something else.
    """

    def __init__(self, quiet: bool, to_stderr: bool = False) -> None:
        self._quiet, self._to_stderr = quiet, to_stderr

    def show(self, *renderables: RenderableType) -> None:
        """Print parts of the summary."""
        if self._quiet:
            return
        try:
            show(Group(*renderables), self._to_stderr)
        except OutputError as error:
            self._quiet = True  # one warning is enough
            warn([Notice(error.code, str(error))])


def warn(notices: Iterable[Notice]) -> None:
    """Print warnings on stderr, one line each with its code at the end."""
    for notice in notices:
        code = f' [{notice.code}]' if notice.code else ''
        write_stderr(f'dashcalib: warning: {" ".join(str(notice).split())}{code}')


class MovingBar(BarColumn):
    """A bar that pulses while its stage works and cannot say how far it is.

    Its tasks have a field since: when their fraction changed, by the clock of the progress, s.
    """

    def render(self, task: Task) -> ProgressBar:
        """Return the task's bar."""
        bar = super().render(task)
        bar.pulse = bar.pulse or task.get_time() - task.fields['since'] > STILL_S
        return bar


class Stages(Observer):
    """The progress of one command, a stage at a time.

    It is drawn on a terminal; elsewhere a line is printed from time to time, in long runs only.
    """

    def __init__(self, quiet: bool = False) -> None:
        console = Console(stderr=True)
        self._lines = not console.is_terminal and not quiet
        self._shown_s = time.monotonic()
        # as wide as it may become, it fits 80 columns
        self._progress = Progress(
            SpinnerColumn(), TextColumn('{task.description}', markup=False), MovingBar(16),
            TaskProgressColumn(), TimeElapsedColumn(), console=console, transient=True,
            disable=quiet or not console.is_terminal)
        self._stage = ''
        self._done: float | None = None
        self._task: TaskID | None = None

    def __enter__(self) -> Stages:
        """Begin to draw."""
        self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        """Remove the drawing."""
        self._progress.stop()

    def show(self, stage: str, share: float | None = None, note: str = '') -> None:
        """Show a stage with the share done, 0 to 1 (None: unknown), and a note beside it."""
        text = visible(f'{stage}: {note}' if note else stage)
        done = None if share is None else min(max(share, 0.0), 1.0)
        if self._lines:
            self._tell(text, done)
            return
        if stage != self._stage or self._task is None:
            if self._task is not None:
                self._progress.remove_task(self._task)
            self._task = self._progress.add_task(stage, total=None, since=time.monotonic())
            self._stage = stage
        if done != self._done:
            self._done = done
            self._progress.update(self._task, since=time.monotonic())
        self._progress.update(self._task, description=text, total=None if done is None else STEPS,
                              completed=0 if done is None else STEPS * done)

    def closing(self) -> AbstractContextManager[None]:
        """Let the child processes end, even if Ctrl-C is pressed again meanwhile."""
        return handling(signal.SIG_IGN, signal.SIGINT, signal.SIGTERM)

    def _tell(self, text: str, done: float | None) -> None:
        now = time.monotonic()
        if now - self._shown_s >= EVERY_S:
            self._shown_s = now
            write_stderr(f'dashcalib: {text}' + ('' if done is None else f', {100 * done:.0f} %'))
