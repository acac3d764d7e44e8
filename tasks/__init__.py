"""The stages of the pipeline: one thin Prefect task each, table in, table out."""

from pathlib import Path

from epipole.io.kernel_cache import use_kernel_cache

use_kernel_cache(Path(__file__).parent / "algorithms")
