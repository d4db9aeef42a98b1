"""What a robot keeps on its disk to be started again, as far as the disk takes it."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from gmmtorch.cli import common

if TYPE_CHECKING:
    from gmmtorch.sharing.journal import Journal
    from gmmtorch.sharing.transport.frames import FramedTransport


class RobotMemory:
    """The files of `journal.*` of one robot: its map, how far it is in a log, the sessions it has begun, and
    the facts: of which world or log that is.

    A disk that fails is told of once, and the robot goes on without; what can be read is used. Files that
    are damaged, of another world or log, or in use are errors.
    """

    def __init__(self, config: DictConfig, folder: Path) -> None:
        self._robot, self._sync = config.id, config.journal.sync
        self._is_on = config.journal.enabled and config.clock == "wall"
        given = config.journal.folder
        self._home = folder if given is None else Path(given)
        self._option = f"hydra.run.dir={folder}" if given is None else f"journal.folder={given}"
        self._facts = facts_of(config) if self._is_on else {}
        self._is_told = False

    def check(self) -> None:
        """Raises `InvalidArgumentError` where what is kept is of another world or log."""
        from gmmtorch.sharing.journal_facts import check_facts

        if self._is_on:
            with self._naming():
                check_facts(self._place("facts", ".json"), self._facts)

    def disown_former(self, transport: FramedTransport) -> None:
        """What the robot said before it was started again is no other robot's, though it has its number."""
        from gmmtorch.sharing.former_sessions import former_sessions, known_sessions

        if self._is_on:
            path = self._place("sessions")
            transport.disown(known_sessions(path))
            with self._going_on():
                former_sessions(path, transport.session)

    def journal(self, replica: object, stack: ExitStack) -> Journal | None:
        """What keeps the robot's map, if it is one that can be kept; closed with the stack. The map is
        restored from what can be read in any case."""
        from gmmtorch.sharing.journal import Journal
        from gmmtorch.sharing.journal_facts import keep_facts
        from gmmtorch.sharing.replica.replica import Replica

        if self._is_on and isinstance(replica, Replica):
            with self._going_on():
                keep_facts(self._place("facts", ".json"), self._facts)
            with self._going_on(), self._naming():
                return stack.enter_context(Journal(self._place("journal"), replica, sync=self._sync))
        return None

    @property
    def progress(self) -> Path | None:
        """The folder for how far the robot is in its log."""
        return self._place("progress") if self._is_on else None

    def _place(self, what: str, suffix: str = "") -> Path:
        return self._home / f"{what}_{self._robot}{suffix}"

    def _naming(self) -> AbstractContextManager[None]:
        """Within it errors call the place of a file by the option that it comes from."""
        return common.naming({"path": self._option.split("=")[0]})

    @contextmanager
    def _going_on(self) -> Iterator[None]:
        from gmmtorch.errors import OutputError

        try:
            yield
        except OutputError as error:
            if not self._is_told:
                common.logger.warning(
                    "The robot goes on, but started again it will not have all that it had, as %s fails: %s "
                    "Take another journal.folder, or journal.enabled=false.",
                    self._option,
                    error,
                )
            self._is_told = True


def facts_of(config: DictConfig) -> dict[str, Any]:
    """What must be the same for a robot that is started again, by option."""
    return _facts_of_world(config) if config.source == "world" else _facts_of_log(config)


def _facts_of_world(config: DictConfig) -> dict[str, Any]:
    """What makes its surfaces. Which part of them is explored, in what cells, and how the team senses, plans
    and flies may change: components say where something is, whoever has found it."""
    world = common.as_options(config.world)
    facts = {"source": "world", "world": world["name"]}
    facts |= {f"world.{name}": world[name] for name in ("size", "seed") if name in world}
    path = None if OmegaConf.is_missing(config.world, "path") else world.get("path")
    if path is not None and (file := Path(path).expanduser()).is_file():
        with file.open("rb") as mesh:  # it may lie elsewhere, and something else where it was
            facts["mesh"] = hashlib.file_digest(mesh, "sha256").hexdigest()
    return facts


def _facts_of_log(config: DictConfig) -> dict[str, Any]:
    """Which log it is, and which part of it."""
    dataset = common.as_options(config.log.dataset)
    if dataset.get("path") is not None:
        dataset["path"] = str(Path(dataset["path"]).resolve())
    return {
        "source": "log",
        **{f"log.dataset.{name}": value for name, value in dataset.items()},
        **{f"log.{name}": config.log[name] for name in ("every", "part")},
        "team.size": config.team.size,
    }
