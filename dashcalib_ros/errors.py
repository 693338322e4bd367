# SPDX-License-Identifier: Apache-2.0
"""All errors that a user can cause. The core raises them; only the borders (cli, ros) catch them.

Each has a code and one line of text with the problem and its remedy, and so have warnings.
docs/messages.md lists them.
"""
from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

T = TypeVar('T')

# control characters, line ends among them, and those that turn the direction of writing
HIDDEN = re.compile(r'[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]')


def visible(text: str) -> str:
    """Return a text for one line of a terminal or a log: what would act there is written out."""
    return HIDDEN.sub(lambda found: found[0].encode('unicode_escape').decode(), text)


def one_line(error: BaseException, limit: int = 160) -> str:
    """Return another library's error message, or else its type, on one short line."""
    return shortened(' '.join(str(error).split()) or type(error).__name__, limit)


def coded(message: Exception | Notice | str, limit: int = 1000) -> str:
    """Return a message on one line, with its code at the end if it has one."""
    text = (one_line(message, limit) if isinstance(message, Exception) else
            shortened(str(message), limit))
    code = code_of(message)
    return text + (f' [{code}]' if code else '')


def code_of(message: object) -> str:
    """Return the code of an error or a notice, '' for what has none."""
    return message.code if isinstance(message, (DashcalibError, Notice)) else ''


def spared(what: str, lost: list[Notice], make: Callable[..., T], *arguments: object) -> T | None:
    """Return what a function returns; where it raises, None, with a line about it in lost.

    For all that comes after a solution: a plot, a sensor or a picture must not cost the result.
    """
    try:
        return make(*arguments)
    except Exception as error:
        reason = str(error) and f': {one_line(error)}'
        lost.append(Notice('E-PART-MISSING', f'{what} could not be made, and the rest of the '
                           f'result does not depend on it ({type(error).__name__}{reason}); '
                           f'report this, with the input if you can'))
        return None


@dataclass(frozen=True)
class Notice:
    """A warning, or another line for the user that is not an error, with a code as errors have it.

    what, remedy: parts of one line for people, which is str(notice). The code is for scripts, and
    stays when the text is reworded.
    """

    code: str
    what: str
    remedy: str = ''

    def __str__(self) -> str:
        return f'{self.what}: {self.remedy}' if self.remedy else self.what


def shortened(text: str, limit: int = 160) -> str:
    """Return the text, or its beginning where it is too long for a message."""
    return text if len(text) <= limit else text[:limit - 1] + '…'


def counted(count: int, what: str) -> str:
    """Return a number of things in words: 1 turn, 2 turns."""
    return f'{count} {what}{"" if count == 1 else "s"}'


class DashcalibError(Exception):
    """Root of all errors that this package raises on purpose.

    code: identifies the problem, such as E-FILE-EMPTY. It does not change when the text does: use
    it in scripts. text: one line with the problem and its remedy; str(error) is the text alone.
    """

    def __init__(self, code: str, text: str) -> None:
        super().__init__(code, text)
        self.code, self.text = code, text

    def __str__(self) -> str:
        return self.text


class InputError(DashcalibError):
    """An input cannot be used: it is missing, empty, damaged, ambiguous or not supported."""


class ConfigError(DashcalibError):
    """A setting is unknown, of the wrong type, NaN, or out of its range."""


class OutputError(DashcalibError):
    """A result cannot be written: the disk is full, or the place is not writable."""


class NotAcceptedError(DashcalibError):
    """An accepted calibration is required, and this one is weak or refused."""


class WorkerError(DashcalibError):
    """The child process for the reconstruction died or could not be started."""
