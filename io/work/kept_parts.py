"""Kept parts: what a run with other logs made of the same rows is not made again.

A part that depends on some rows only has a key: a digest of these rows, and of what else it is made
from. Where a run with the same settings and code has made such a part of the night before, it is
taken from there: parts that are kept lie in one folder, by their keys. Parts without a key are made
in every run.
"""

import contextlib
import hashlib
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import pyarrow as pa

KEY = "key"  # a file of a part: its key
BATCH_ROWS = 65_536  # of a table that are digested at once: a few megabytes


def part_key(
    made_from: Iterable[object], tables: Iterable[pa.Table] = (), parts: Iterable[Path] = ()
) -> str | None:
    """Return the key of a part: a digest of what it is made from; None where this cannot be said.

    Equal rows give the same key, however they are divided into chunks.

    Parameters
    ----------
    made_from
        Values that have a text: numbers, names, spans.
    tables
        Rows that it is made from.
    parts
        Other parts that it is made from, in an order that is always the same. One of them without a
        key leaves it without one.
    """
    keys = [key_of(part) for part in parts]
    if None in keys:
        return None
    digest = hashlib.blake2b(digest_size=16)
    for value in (*made_from, *keys):
        digest.update(f"{value!r}\0".encode())
    for rows in tables:
        digest.update(f"{rows.num_rows} {rows.column_names}\0".encode())
        for batch in rows.combine_chunks().to_batches(max_chunksize=BATCH_ROWS):
            digest.update(batch.serialize())
    return digest.hexdigest()


def key_of(part: Path) -> str | None:
    """Return the key of a part; None where it has no key, or does not exist."""
    try:
        key = (part / KEY).read_text()
    except (OSError, UnicodeDecodeError):
        return None
    return key if re.fullmatch("[0-9a-f]{32}", key) else None


def take_part(part: Path, kept: Path | None, key: str | None) -> bool:
    """Move the kept part with this key to the path of a part; return whether there was one."""
    if kept is None or key is None or not (kept / key).is_dir():
        return False
    part.parent.mkdir(parents=True, exist_ok=True)
    try:
        (kept / key).rename(part)
    except OSError:  # another worker was first
        return part.is_dir()
    return True


def move_parts(folder: Path, kept: Path) -> None:
    """Move the parts that have a key from a work folder to the folder of those that are kept."""
    kept.mkdir(parents=True, exist_ok=True)
    for part, key in list(_keyed(folder)):
        with contextlib.suppress(OSError):  # it is there already
            part.rename(kept / key)


def _keyed(folder: Path) -> Iterator[tuple[Path, str]]:
    """Yield the complete parts in a folder that have a key, each with it."""
    for file in folder.rglob(KEY):
        is_complete = not file.parent.name.startswith(".")
        if is_complete and (key := key_of(file.parent)) is not None:
            yield file.parent, key
