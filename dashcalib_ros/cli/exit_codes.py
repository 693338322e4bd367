"""The exit codes of the command."""
from __future__ import annotations

ACCEPTED = 0
WRONG = 1  # of check: the calibration does not explain the drive
BAD_INPUT = 2  # or bad usage: one line on stderr says what and the cure
NOT_ENOUGH = 3  # weak or refused: the input was fine, the evidence was not enough
INTERRUPTED = 130  # Ctrl-C or SIGTERM, as shells have it


def of_verdict(level: str) -> int:
    """Return the exit code for a verdict."""
    return ACCEPTED if level == 'accepted' else NOT_ENOUGH


def of_answer(answer: str) -> int:
    """Return the exit code for an answer of check."""
    return {'right': ACCEPTED, 'wrong': WRONG}.get(answer, NOT_ENOUGH)
