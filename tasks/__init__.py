"""The stages of the pipeline: one thin Prefect task each, table in, table out."""

from pathlib import Path

from epipole.io.caches.kernels import use_kernel_cache

_HERE = Path(__file__).parent
use_kernel_cache(_HERE / "algorithms", _HERE.parent / "io")
