"""Starts a command. `main` of each command is `app.start(NAME, run)`.

It installs what all commands share: Ctrl-C always ends a command, an error is one line, and a job of a
sweep that fails does not end the sweep.
"""

from __future__ import annotations

import _thread
import argparse
import io
import logging
import math
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import hydra
from hydra._internal.utils import get_args_parser
from hydra.errors import HydraException
from omegaconf import DictConfig

from gmmtorch.cli import common, options_help, schema
from gmmtorch.cli.sweep_table import ERROR_FILE
from gmmtorch.errors import GmmTorchError, OutputError, printable
from gmmtorch.processes import end_with_parent

_FULL_ERROR = "HYDRA_FULL_ERROR"
"""Environment variable with which Hydra raises its errors."""


def start(name: str, run: Callable[[DictConfig], Any], register: Callable[[], None]) -> None:
    """Run the command gmmtorch-`name` with the arguments of this process.

    Args:
        name: name of the command and of its file in conf/.
        run: does the work for a configuration. Its result is what a sweep can optimize. A `GmmTorchError`
            becomes a one-line message and exit status 1.
        register: stores the schemas of the command in Hydra's config store.
    """
    register()
    _print_any_text()
    logging.setLogRecordFactory(PrintableRecord)
    try:
        with interruptible(), _any_help():
            _hydra_main(name, run)
    except KeyboardInterrupt:
        print("gmmtorch: interrupted; all files that were written are complete.", file=sys.stderr)
        sys.exit(130)
    finally:
        common.drop_unwritable()


def _print_any_text() -> None:
    """Characters that the encoding of the output lacks are printed as a question mark.

    Without this they are errors: on Windows, output to a file or a pipe has a code page of 256 characters.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


class PrintableRecord(logging.LogRecord):
    """Names in logs, such as those of frames in a bag, cannot send control characters to the terminal."""

    def getMessage(self) -> str:  # noqa: N802  the name that logging calls
        return printable(super().getMessage())


@contextmanager
def interruptible() -> Iterator[None]:
    """SIGINT raises `KeyboardInterrupt` here, even if the process was started with SIGINT ignored.

    A shell starts background processes with SIGINT ignored. Python drops an exception that is raised
    in `__del__` or in a callback of a library; such an interrupt is sent again.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    hook = sys.unraisablehook

    def send_again(dropped: sys.UnraisableHookArgs) -> None:
        if issubclass(dropped.exc_type, KeyboardInterrupt):
            # From another thread, because an interrupt in this function would be dropped, too.
            # Thread.start would take locks, which the interrupted code may hold.
            _thread.start_new_thread(_interrupt, ())
        else:
            hook(dropped)

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.unraisablehook = send_again
    try:
        yield
    finally:
        sys.unraisablehook = hook
        signal.signal(signal.SIGINT, signal.SIG_DFL if handler is None else handler)


@contextmanager
def _any_help() -> Iterator[None]:
    """argparse accepts help texts that are not strings: Hydra 1.3 has one, which Python 3.14 refuses."""
    container: Any = argparse._ActionsContainer
    check = getattr(container, "_check_help", None)
    if check is None:
        yield
        return
    container._check_help = lambda self, action: isinstance(action.help, str) and check(self, action)
    try:
        yield
    finally:
        container._check_help = check


@contextmanager
def stop_requests(by_force: bool = True) -> Iterator[Callable[[], bool]]:
    """Yields whether Ctrl-C was pressed, or the process was asked to end.

    by_force: a second request interrupts at once.
    """
    requests: list[int] = []

    def request(number: int, frame: Any) -> None:
        if requests and by_force:
            raise KeyboardInterrupt
        requests.append(number)

    before = {number: signal.signal(number, request) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(requests)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _interrupt() -> None:
    time.sleep(0.01)  # until `__del__` has returned; if it has not, the interrupt is dropped and sent again
    _thread.interrupt_main()  # on Windows os.kill would end the process at once


def _hydra_main(name: str, run: Callable[[DictConfig], Any]) -> None:
    """Run a command by Hydra, with our own help, completion and errors of options."""
    from omegaconf.errors import OmegaConfBaseException

    if "--version" in sys.argv[1:]:
        import gmmtorch

        print(f"gmmtorch {gmmtorch.__version__}")
        return
    flags = get_args_parser().parse_args()
    is_running: list[bool] = []

    def task(config: DictConfig) -> Any:
        is_running.append(True)
        return _guarded(run, config)

    try:
        if flags.help:
            print(options_help.help_text(name, flags.overrides))
        elif flags.shell_completion and {"query=bash", "query=fish"} & {*flags.overrides}:
            found = options_help.completions(name, os.environ["COMP_LINE"])
            print(*found, sep=" " if "query=bash" in flags.overrides else "\n")
        else:
            options_help.check_choices(name, flags.overrides)
            with _raising():
                hydra.main(version_base="1.3", config_path=common.conf_dir(), config_name=name)(task)()
    except GmmTorchError as error:
        sys.exit(f"gmmtorch: error: {error!s}")
    except (HydraException, OmegaConfBaseException) as error:
        if is_running:
            raise
        sys.exit(f"gmmtorch: error: {options_help.explained(name, flags.overrides, error)}")
    except OSError as error:
        if is_running:
            raise
        place = f" of {error.filename}" if error.filename else ""
        option = "hydra.sweep.dir" if flags.multirun else "hydra.run.dir"
        sys.exit(
            f"gmmtorch: error: {option} cannot be written because{place}: {error.strerror or error}; "
            f"give another folder, as in {option}=/tmp/run."
        )


@contextmanager
def _raising() -> Iterator[None]:
    """Hydra raises its errors instead of printing them."""
    before = os.environ.get(_FULL_ERROR)
    os.environ[_FULL_ERROR] = "1"
    try:
        yield
    finally:
        del os.environ[_FULL_ERROR]
        if before is not None:
            os.environ[_FULL_ERROR] = before


def _result_of(run: Callable[[DictConfig], Any], config: DictConfig) -> Any:
    """The result of a command.

    Raises `MissingDataError` for an input that does not exist, before the imports that take seconds, and
    `MemoryLimitError` if the memory of the device is too small.
    """
    common.check_inputs(config)
    common.print_start()
    try:
        return run(config)
    except RuntimeError as error:
        import torch  # takes a second, which errors of options need not wait for

        from gmmtorch.kernels import memory_error

        if isinstance(error, torch.OutOfMemoryError):
            raise memory_error(error) from error
        raise


def _saved() -> str:
    """A sentence on the files of a run that a full disk or the like has ended; each is complete."""
    files = (file for file in common.run_dir().glob("[!.]*.*") if file.suffix != ".log" and file.is_file())
    names = sorted(file.name for file in files)
    return f" Saved in {common.run_dir()}: {', '.join(names)}." if names else ""


def _guarded(run: Callable[[DictConfig], Any], config: DictConfig) -> Any:
    """The result of a command; an error ends the command, or only its job of a sweep."""
    end_with_parent()  # a job of a sweep in its own process ends if the sweep's process ends
    if not common.is_job_of_sweep():
        try:
            return _result_of(run, config)
        except GmmTorchError as error:
            saved = _saved() if isinstance(error, OutputError) else ""
            sys.exit(f"gmmtorch: error: {error.told(schema.option_names(config))}{saved}")
    note = common.run_dir() / ERROR_FILE
    note.unlink(missing_ok=True)  # of an earlier sweep in this folder
    try:
        return _result_of(run, config)
    except GmmTorchError as error:
        text = str(error.told(schema.option_names(config)))
    except Exception as error:
        text = f"{traceback.format_exc()}{type(error).__name__}: {error}"
    note.write_text(text, encoding="utf-8")
    return math.nan  # for optimizers
