"""Tasks of a stage: named by it, their runs by what they work on, tried again only if asked."""

import pytest

from epipole.schemas.stages import Stage
from epipole.tasks.common.retries import DELAYS_S, RETRIES, storage_failed
from epipole.tasks.common.stage_tasks import stage_task


@pytest.mark.parametrize("stage", Stage)
def test_a_task_has_the_name_of_its_stage(stage):
    @stage_task(stage, "{sensor} {span}")
    def work(sensor, span):
        return sensor, span

    assert work.name == stage.value
    assert work.task_run_name == f"{stage} {{sensor}} {{span}}"
    assert work.fn(1, 2) == (1, 2)


def test_only_tasks_that_ask_for_it_are_tried_again():
    once = stage_task(Stage.TRACK, "x")(lambda: None)
    again = stage_task(Stage.READ, "x", retried=True)(lambda: None)
    assert (once.retries, once.retry_condition_fn) == (0, None)
    assert (again.retries, again.retry_delay_seconds) == (RETRIES, DELAYS_S)
    assert again.retry_condition_fn is storage_failed
