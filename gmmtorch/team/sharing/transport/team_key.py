"""TeamKey: the secret key of a team."""

from __future__ import annotations

import hmac
import os
import secrets
import stat
from pathlib import Path
from typing import NoReturn

from gmmtorch.errors import DataError, InvalidArgumentError, MissingDataError, OutputError

KEY_BYTES = 32
KEY_VARIABLE = "GMMTORCH_TEAM_KEY"
"""Environment variable that may contain the key."""
_HELP = f"A key is {KEY_BYTES} bytes as {2 * KEY_BYTES} hexadecimal digits: `openssl rand -hex 32`."


class TeamKey:
    """The secret that all robots of a team share. Neither `repr` nor any error shows it."""

    __slots__ = ("_data",)

    def __init__(self, data: bytes) -> None:
        """`data`: 32 random bytes."""
        if not isinstance(data, bytes) or len(data) != KEY_BYTES:
            what = f"{len(data)} bytes" if isinstance(data, bytes) else f"of type {type(data).__name__}"
            raise InvalidArgumentError(f"The team key is {what}; it must be {KEY_BYTES} bytes.")
        self._data = data

    @classmethod
    def generate(cls) -> TeamKey:
        """A new key, from the operating system's random numbers."""
        return cls(secrets.token_bytes(KEY_BYTES))

    @classmethod
    def from_file(cls, path: str | Path) -> TeamKey:
        """The key in a file of 64 hexadecimal digits that only its owner may read.

        Raises `MissingDataError` if there is no file, and `DataError` if it contains something else, or if
        other users may read or write it.
        """
        path = Path(path)
        try:
            if not path.is_file():
                raise MissingDataError(
                    f"The team key {path} {'is no file' if path.exists() else 'does not exist'}. Copy the "
                    f"team's key there, or make one: `(umask 077; openssl rand -hex 32 > {path})`."
                )
            with path.open("rb") as file:
                mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
                data = file.read(1024)
        except MissingDataError:
            raise
        except OSError as error:
            raise DataError(f"The team key {path} cannot be read: {error.strerror}.") from None
        if os.name == "posix" and mode & 0o077:
            raise DataError(
                f"The team key {path} has mode {mode:o}: other users than its owner may read or write it. "
                f"`chmod 600 {path}`; if others have used this machine, make a new key."
            )
        return cls._from_hex(data, f"The team key {path}")

    @classmethod
    def from_environment(cls, variable: str = KEY_VARIABLE) -> TeamKey:
        """The key in an environment variable, as 64 hexadecimal digits. Raises as `from_file` does."""
        text = os.environ.get(variable)
        if text is None:
            raise MissingDataError(f"${variable} is not set. {_HELP}")
        return cls._from_hex(text.encode(errors="replace"), f"The team key in ${variable}")

    @classmethod
    def _from_hex(cls, data: bytes, what: str) -> TeamKey:
        """The key of hexadecimal digits. Errors show the length of the data, but no data."""
        digits = data.strip()
        if len(digits) != 2 * KEY_BYTES:
            raise DataError(f"{what} has {len(digits)} characters. {_HELP}")
        try:
            return cls(bytes.fromhex(digits.decode("ascii")))
        except ValueError:
            raise DataError(f"{what} has characters that are no hexadecimal digits. {_HELP}") from None

    def save(self, path: str | Path) -> Path:
        """Write a file that `from_file` reads. Raises `OutputError` if the file exists already."""
        path = Path(path)
        try:
            handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        except OSError as error:
            raise OutputError(f"The team key {path} cannot be written: {error.strerror}.") from None
        try:
            with os.fdopen(handle, "w") as file:
                file.write(self._data.hex() + "\n")
        except OSError as error:
            path.unlink(missing_ok=True)
            raise OutputError(f"The team key {path} cannot be written: {error.strerror}.") from None
        return path

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TeamKey) and hmac.compare_digest(self._data, other._data)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return "TeamKey(…)"

    def __reduce__(self) -> NoReturn:
        raise InvalidArgumentError("A TeamKey cannot be pickled or copied: give other processes its file.")
