"""Names as small integers, which the compiled scans and the decoded messages share."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.io.logs.messages.scan import MAX_NAMES, NAME_BYTES, new_names


class NameCodes:
    """Codes of names, counted from 0 in the order in which the names appear."""

    def __init__(self, names: Sequence[str] = ()) -> None:
        self.table = new_names()
        self._names: list[str] = []
        self._codes: dict[str, int] = {}
        for name in names:
            self.code(name)

    def names(self) -> list[str]:
        """Return the names by code, with those that a scan has added."""
        n = int(self.table.n[0])
        for code in range(len(self._names), n):  # empty once the table is full
            name = self.table.text[code, : self.table.length[code]].tobytes().decode()
            self._codes[name] = code
            self._names.append(name)
        return self._names

    def code(self, name: str) -> int:
        """Return the code of a name, new or known."""
        names = self.names()
        code = self._codes.setdefault(name, len(names))
        if code == len(names):
            names.append(name)
            self._enter(code, name.encode())
        return code

    def _enter(self, code: int, text: bytes) -> None:
        """Add a name to the table of the scans, if there is room; they stop at a name without."""
        if code >= MAX_NAMES or len(text) > NAME_BYTES:
            return
        self.table.text[code, : len(text)] = np.frombuffer(text, np.uint8)
        self.table.length[code] = len(text)
        self.table.n[0] = code + 1

    def strings(self, codes: npt.NDArray[np.int32]) -> pa.Array:
        """Return the names of codes as a column."""
        dictionary = pa.array(self.names(), pa.string())
        return pa.DictionaryArray.from_arrays(pa.array(codes), dictionary).cast(pa.string())
