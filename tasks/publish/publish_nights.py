"""Publish nights: the staged tables become the dataset's, all at once."""

from collections.abc import Mapping
from pathlib import Path

import pyarrow as pa

from epipole.io.datasets.dataset import publish_folders
from epipole.schemas.stages import Stage
from epipole.tasks.common.stage_tasks import stage_task


@stage_task(Stage.PUBLISH, "all nights", retried=True)
def publish_nights(
    dataset: str, staged: Mapping[str, Path], sources: pa.Table, replace: bool
) -> None:
    """Put the staged nights in place in the dataset; see `publish_folders`."""
    publish_folders(dataset, staged, sources, replace)
