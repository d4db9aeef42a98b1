"""StatusLine: one line of status on standard error."""

from __future__ import annotations

import logging
import sys


class StatusLine(logging.Handler):
    """On a terminal, each status line replaces the last; in a file it is appended.

    As a handler of the log it ends the status line before each record, so that records have their own lines.
    """

    def __init__(self) -> None:
        super().__init__()
        self._width = 0  # of the line that the terminal's cursor is on

    def show(self, line: str) -> None:
        """Shows a line. Raises `OSError` if standard error cannot be written."""
        self.acquire()  # other threads may log
        try:
            if sys.stderr.isatty():
                sys.stderr.write("\r" + line.ljust(self._width))
                self._width = len(line)
            else:
                sys.stderr.write(line + "\n")
            sys.stderr.flush()
        finally:
            self.release()

    def end(self) -> None:
        """Starts a new line if there is a status line. Raises `OSError`."""
        if self._width:
            self._width = 0
            sys.stderr.write("\n")
            sys.stderr.flush()

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self.end()
        except OSError:
            self.handleError(record)
