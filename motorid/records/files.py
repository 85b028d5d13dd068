"""Files in and out: what is read is a file of bounded size; what is written is whole, and over nothing else."""

import contextlib
import errno
import json
import os
import re
import stat
import tempfile
from collections.abc import Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from motorid.errors import DataError, OutputError, UsageError, otherwise

MOST_BYTES = 256_000_000  # of a file that is read; a table takes about eight times as much memory
_LOOK = 65_536  # bytes at either end in which an output says that motorid wrote it
# What the outputs carry: JSON, page, C, table of motors, record of an export, simulated run, figure, CasADi file.
_OURS = re.compile(rb'"motorid": ?"(\d|unknown)|name="generator" content="motorid|[Ww]ritten by motorid|'
                   rb'\Amotor,status,message,|"motor":"[^"]*",\s*"status"|"index_columns": \["motor"\]'
                   rb"|\At,[\w,]*substeps\n|\A# motorid columns: |Software\0motorid")
_ODD = re.compile("[\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
_WRONG_PLACE = (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EACCES, errno.EPERM, errno.EROFS, errno.ENAMETOOLONG)


def package_version(package: str) -> str:
    """Return the version of an installed package."""
    return otherwise("unknown", metadata.PackageNotFoundError, lambda: metadata.version(package))


def read_bytes(path: Path) -> bytes:
    """Return the contents of a regular file of at most 256 MB."""
    try:
        about = path.stat()
        if stat.S_ISDIR(about.st_mode):
            raise DataError(f"cannot read {path}: it is a directory; use read_runs.")
        if not stat.S_ISREG(about.st_mode):
            raise DataError(f"cannot read {path}: it is a device or a pipe, which may have no end; save what it gives "
                            "in a file first.")
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1) if about.st_size <= MOST_BYTES else b""
    except (OSError, ValueError) as error:
        raise DataError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}.") from None
    if max(about.st_size, len(data)) > MOST_BYTES:
        raise DataError(f"cannot read {path}: it has {about.st_size / 1e6:.0f} MB, at most {MOST_BYTES / 1e6:.0f} MB "
                        "are read. Cut it into runs, or leave out samples.")
    return data


def check_output(path: str | Path, force: bool = False) -> Path:
    """Return the file to write: `path`, or what it links to."""
    target = Path(os.path.expanduser(path))
    try:
        if "\0" in str(target):
            raise ValueError("no name of a file holds a zero byte")
        if (target := target.resolve() if target.is_symlink() else target).is_dir() or not target.parent.is_dir():
            raise UsageError(f"cannot write {path}: " + ("it is a folder." if target.is_dir() else
                             f"there is no folder {target.parent}."))
        if (target.is_file() or not target.exists()) and not os.access(target.parent, os.W_OK):
            raise UsageError(f"cannot write {path}: its folder cannot be written to. Choose another one.")
        if force or not target.is_file():
            return target
        with target.open("rb") as file:
            ends = [file.read(_LOOK)]
            file.seek(max(0, target.stat().st_size - _LOOK))
            ends.append(file.read())
    except (OSError, ValueError, RuntimeError) as error:  # RuntimeError: a loop of links
        raise UsageError(f"cannot write {path}: {getattr(error, 'strerror', None) or error}.") from None
    if ends[0] and not any(_OURS.search(end) for end in ends):
        raise UsageError(f"cannot write {path}: that file exists and motorid did not write it. Choose another name, "
                         "or replace it with --force (force=True).")
    return target


def write_files(files: Mapping[Path, str | bytes], force: bool = False) -> list[Path]:
    """Write `files` (str as UTF-8, or bytes) whole or not at all: aside, carried to the disk, then renamed. The only
    way in which outputs are written; `force`: also over files that motorid did not write."""
    targets = [check_output(path, force) for path in files]
    try:
        with contextlib.ExitStack() as aside:
            parts = [aside.enter_context(_part(t, c)) for t, c in zip(targets, files.values(), strict=True)]
            for part, target in zip(parts, targets, strict=True):
                if part is not None:
                    os.replace(part, target)
    except OSError as error:
        kind = UsageError if error.errno in _WRONG_PLACE else OutputError
        raise kind(f"cannot write {', '.join(map(str, files))}: {error.strerror or error}. Choose a folder that can "
                   "be written.") from None
    return list(files)


@contextlib.contextmanager
def _part(target: Path, content: str | bytes) -> Iterator[Path | None]:
    """Write `content` beside `target` and clear up afterwards; at once where `target` is a device or a pipe."""
    data = content.encode("utf-8", "backslashreplace") if isinstance(content, str) else content
    if target.exists() and not target.is_file():
        number = os.open(target, os.O_WRONLY | getattr(os, "O_NONBLOCK", 0))  # a pipe that nobody reads is an error
        if hasattr(os, "set_blocking"):
            os.set_blocking(number, True)
        with open(number, "wb") as device:
            device.write(data)
        yield None
        return
    number, name = tempfile.mkstemp(prefix=f".{target.name[:60]}.", suffix=".part", dir=target.parent)
    try:
        with open(number, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(number)
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(name, stat.S_IMODE(target.stat().st_mode) if target.exists() else 0o666 & ~umask)
        yield Path(name)
    finally:
        with contextlib.suppress(OSError):
            os.unlink(name)


def plain(value: Any) -> Any:
    """Return `value` in the types that JSON knows; what is not a finite number becomes None."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(v) for v in value]
    if isinstance(value, float):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    return value if value is None or isinstance(value, str | int) else str(value)


def json_text(contents: Mapping[str, Any], bulk: Mapping[str, Any] | None = None) -> str:
    """Return JSON signed by motorid, `bulk` on a line of its own, control characters and lone surrogates escaped."""
    signed = plain({"motorid": package_version("motorid"), **contents})
    text = json.dumps(signed, indent=1, ensure_ascii=False, allow_nan=False)
    if bulk is not None:
        text = f"{text[:-2]},\n{json.dumps(plain(bulk), allow_nan=False)[1:-1]}\n}}"
    return _ODD.sub(lambda m: f"\\u{ord(m[0]):04x}", text) + "\n"
