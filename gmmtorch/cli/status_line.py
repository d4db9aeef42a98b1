"""A line on standard error that says how things are."""

from __future__ import annotations

import logging
import sys


class StatusLine(logging.Handler):
    """On a terminal each line takes the place of the last one; in a file it stands below it.

    While it is shown it also hears the log: a record ends the line, and so has one of its own.
    """

    def __init__(self) -> None:
        super().__init__()
        self._width = 0  # of the line that the terminal's cursor is on

    def show(self, line: str) -> None:
        """Show a line. Raises `OSError` where standard error cannot be written."""
        self.acquire()  # others may log meanwhile
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
        """Go to a new line, if a line is there. Raises `OSError`."""
        if self._width:
            self._width = 0
            sys.stderr.write("\n")
            sys.stderr.flush()

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self.end()
        except OSError:
            self.handleError(record)
