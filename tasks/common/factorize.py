"""Text ranks: numbers in place of the texts of a column."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa


class Factorized(NamedTuple):
    """The rank of each row's text, (n,) int, among the distinct ones (-1: null); and these, in
    order."""

    rank: npt.NDArray[np.int64]
    texts: npt.NDArray[np.str_]


def factorize(values: pa.Table, name: str) -> Factorized:
    """Return the ranks of a column of texts."""
    encoded = values[name].combine_chunks().dictionary_encode()
    texts = np.array(encoded.dictionary.to_pylist(), np.str_)
    order = np.argsort(texts)
    rank = np.full(len(order) + 1, -1)
    rank[order] = np.arange(len(order))
    return Factorized(rank[encoded.indices.fill_null(len(order)).to_numpy()], texts[order])
