"""The stages of the pipeline: one thin Prefect task each, table in, table out."""

from pathlib import Path

from epipole.schemas.one_thread import use_one_thread

use_one_thread()

from epipole.io.caches.kernels import use_kernel_cache  # noqa: E402  it imports numpy

_HERE = Path(__file__).parent
use_kernel_cache(_HERE / "algorithms", _HERE.parent / "io")
