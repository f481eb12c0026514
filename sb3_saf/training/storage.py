"""Files of Optuna studies that several processes share."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Final

import optuna

_SQLITE: Final = "sqlite:///"
_JOURNAL: Final = ".log"
_ATTEMPTS: Final = 10


def open_storage(storage: str, *, must_exist: bool = False) -> None:
    """
    See that a storage can be used, and make its tables, before many workers do.

    :param storage: ``sqlite:///study.db``, a journal file ``study.log``, or a database's URL
    :param must_exist: whether a file that is not there is an error, rather than made
    :raises ValueError: if it cannot be opened
    """
    path = _file_of(storage)
    if path is not None:
        if must_exist and not path.is_file():
            raise ValueError(f"there is no study file {path}; give the --storage of the tuning")
        path.parent.mkdir(parents=True, exist_ok=True)
    elif "://" not in storage:
        raise ValueError(
            f"--storage must be sqlite:///FILE.db, a journal FILE.log or a database's URL, got {storage!r}"
        )
    if storage.endswith(_JOURNAL):
        return  # any number of processes may append to it
    for attempt in range(_ATTEMPTS):
        try:
            optuna.storages.RDBStorage(storage)
            return
        except Exception as error:  # SQLAlchemy's, which differ by database
            # Two processes that make the tables at once: one of them finds them there the next time.
            if attempt == _ATTEMPTS - 1:
                raise ValueError(f"cannot open the storage {storage!r}: {error}") from error
            time.sleep(0.1 * (attempt + 1))


def _file_of(storage: str) -> Path | None:
    if storage.startswith(_SQLITE):
        return Path(storage.removeprefix(_SQLITE))
    return Path(storage) if storage.endswith(_JOURNAL) else None
