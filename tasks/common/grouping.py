"""Rows in groups: integers for the texts of a column, and runs of equal rows."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.arrays import Integers

# Factorized columns.


class Factorized(NamedTuple):
    """The rank of each row's text, (n,) int, among the distinct ones (-1: null); and these, in
    order."""

    rank: Integers
    texts: npt.NDArray[np.str_]


def factorize(values: pa.Table, name: str) -> Factorized:
    """Return the ranks of a column of texts."""
    encoded = values[name].combine_chunks().dictionary_encode()
    texts = np.array(encoded.dictionary.to_pylist(), np.str_)
    order = np.argsort(texts)
    rank = np.full(len(order) + 1, -1)
    rank[order] = np.arange(len(order))
    return Factorized(rank[encoded.indices.fill_null(len(order)).to_numpy()], texts[order])


# Runs of equal rows.


def group_offsets(*keys: npt.NDArray[Any]) -> Integers:
    """Return where each run of rows that are equal in all keys begins, and where the last one ends.

    Run k has the rows ``bounds[k]:bounds[k + 1]``. Without rows it is [0]: no run.
    """
    begins = np.ones(len(keys[0]), bool)
    begins[1:] = np.any([key[1:] != key[:-1] for key in keys], axis=0)
    return np.append(np.flatnonzero(begins), len(begins)).astype(np.int64)
