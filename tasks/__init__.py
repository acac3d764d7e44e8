"""The stages of the pipeline: one thin Prefect task each, table in, table out."""

from epipole.schemas.one_thread import use_one_thread

use_one_thread()

from epipole.io.caches.kernels import use_kernel_cache  # noqa: E402  it imports numpy

use_kernel_cache()
