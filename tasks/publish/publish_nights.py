"""Publish nights: what is staged becomes the dataset's, all at once."""

from collections.abc import Mapping
from pathlib import Path

import pyarrow as pa
from prefect import task
from prefect.cache_policies import NO_CACHE

from epipole.io.datasets.dataset import publish_folders
from epipole.tasks.common.retries import DELAYS_S, RETRIES, storage_failed


@task(
    name="publish nights",
    cache_policy=NO_CACHE,
    retries=RETRIES,
    retry_delay_seconds=DELAYS_S,
    retry_condition_fn=storage_failed,
)
def publish_nights(
    dataset: str, staged: Mapping[str, Path], sources: pa.Table, replace: bool
) -> None:
    """Put staged nights in place; see `publish_folders`."""
    publish_folders(dataset, staged, sources, replace)
