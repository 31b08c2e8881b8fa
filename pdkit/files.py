"""Writing files so that a crash, a full disk or Ctrl-C never leaves half of one, and reading them with clear errors."""
from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .errors import PdkitError

ROOT = Path(__file__).resolve().parent.parent
DATA = ROOT / "data"

TEMPORARY = ".tmp-"  # in the name of what is just being written


def code_checksum() -> str:
    """Of the kit's own code as it lies here: another one after any edit, committed or not."""
    every = hashlib.sha256()
    for path in sorted(Path(__file__).resolve().parent.rglob("*.py")):
        every.update(path.read_bytes())
    return every.hexdigest()


def runs_root() -> Path:
    """Where results go: runs/ in the project, or the folder that PDKIT_RUNS names."""
    return Path(os.environ.get("PDKIT_RUNS") or ROOT / "runs").expanduser().resolve()


def _told(error: OSError, target: Path) -> PdkitError:
    if error.errno == errno.ENOSPC:
        return PdkitError(f"The disk is full while writing {target}; free some space and run the command again.")
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return PdkitError(f"No permission to write {target}; choose another folder (for runs: --out or PDKIT_RUNS).")
    return PdkitError(f"Cannot write {target}: {error.strerror or error}.")


@contextlib.contextmanager
def atomic_file(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success rename it onto `path`, on failure remove it.

    Raises PdkitError when the folder cannot be written or the disk is full.
    """
    path = Path(path)
    temporary = path.with_name(f"{path.name}{TEMPORARY}{os.getpid()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise _told(error, path) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """The same for a folder: a reader sees the old one, the new one or, for a moment, none (see `recover`), never a mixture.

    Raises PdkitError, too, when something else stands there: a folder that is not empty and has none of the new one's files.
    """
    path = Path(os.path.realpath(path))
    if path == path.parent:
        raise PdkitError(f"{path} cannot be replaced; name a folder below it.")
    temporary = path.with_name(f"{path.name}{TEMPORARY}{os.getpid()}")
    old = path.with_name(f"{path.name}{TEMPORARY}old-{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir()
        yield temporary
        check_replaceable(path, *(part.name for part in temporary.iterdir()))
        if path.exists():
            os.replace(path, old)
        os.replace(temporary, path)
    except OSError as error:
        raise _told(error, path) from error
    finally:
        if old.exists() and not path.exists():  # interrupted between the two renames
            os.replace(old, path)
        shutil.rmtree(temporary, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def discard(path: str | Path) -> None:
    """Remove a folder, so that no reader sees a part of it."""
    path = Path(os.path.realpath(path))
    gone = path.with_name(f"{path.name}{TEMPORARY}{os.getpid()}")
    with contextlib.suppress(FileNotFoundError):
        os.replace(path, gone)
    shutil.rmtree(gone, ignore_errors=True)


def check_replaceable(path: str | Path, *names: str) -> None:
    """Raises PdkitError for a folder that holds something, but none of the files `names`, by which it would be known as one of ours."""
    path = Path(os.path.realpath(path))
    try:
        if path.exists() and not path.is_dir():
            raise PdkitError(f"{path} is a file; name another folder.")
        foreign = path.exists() and any(path.iterdir()) and not any((path / name).exists() for name in names)
    except OSError as error:
        raise _told(error, path) from error
    if foreign:
        raise PdkitError(f"{path} holds something else (no {' or '.join(sorted(names))}); name another folder, or an empty one.")


def check_writable(path: str | Path) -> None:
    """Raises PdkitError where a file could not be written at `path`: to be asked before long work, not after."""
    path = Path(os.path.realpath(path))
    if path.is_dir():
        raise PdkitError(f"{path} is a folder; name a file in it.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise _told(error, path) from error


def recover(path: str | Path) -> None:
    """Put back the folder at `path` that a killed process had moved away for a new one, and remove what such processes left beside it."""
    path = Path(os.path.realpath(path))
    left = [part for part in path.parent.glob(f"{path.name}{TEMPORARY}*") if part.is_dir() and not _alive(part.name.rpartition("-")[2])]
    old = [part for part in left if part.name.startswith(f"{path.name}{TEMPORARY}old-")]
    if old and not path.exists():
        os.replace(max(old, key=lambda part: part.stat().st_mtime), path)
    for part in left:
        shutil.rmtree(part, ignore_errors=True)


def _alive(pid: str) -> bool:
    """Whether another process has this number. Our own was, before we began to write, a dead one's: a restarted container counts anew."""
    if pid == str(os.getpid()):
        return False
    try:
        os.kill(int(pid), 0)
    except (ProcessLookupError, ValueError):
        return False
    except PermissionError:
        return True
    return True


@contextlib.contextmanager
def locked(path: str | Path, busy: str) -> Iterator[None]:
    """Within this block no other process is in one with the same lock file. Raises PdkitError with the sentence `busy` where one is, and
    where the file cannot be written. On a disk without locks nobody can be told, and the block runs."""
    try:
        handle = open(path, "a")
    except OSError as error:
        raise _told(error, Path(path)) from error
    with handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise PdkitError(busy) from None
        except OSError as error:
            if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP):
                raise _told(error, Path(path)) from error
        yield


def write_json(path: str | Path, value: Any) -> None:
    """Write `value` as readable JSON, atomically. NaN is written as NaN, which Python reads back."""
    with atomic_file(path) as temporary:
        temporary.write_text(json.dumps(value, indent=1, default=_plain) + "\n")


def _plain(value: Any) -> Any:
    """numpy numbers, arrays and paths as JSON types."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} is not a JSON type")


def read_json(path: str | Path) -> Any:
    """Read JSON. Raises PdkitError when the file is missing or is not JSON."""
    path = Path(path)
    try:
        return json.loads(path.read_text())
    except FileNotFoundError:
        raise PdkitError(f"{path} does not exist.") from None
    except (json.JSONDecodeError, UnicodeDecodeError):
        raise PdkitError(f"{path} is not a readable JSON file; it may be truncated or foreign.") from None
    except OSError as error:
        raise PdkitError(f"Cannot read {path}: {error.strerror}.") from None


def sha256(path: str | Path) -> str:
    """Checksum of a file, hexadecimal."""
    digest = hashlib.sha256()
    with open(path, "rb") as handle:
        for block in iter(lambda: handle.read(1 << 20), b""):
            digest.update(block)
    return digest.hexdigest()
