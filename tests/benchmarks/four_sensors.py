"""The scene of four low sensors and nine geostationary objects, changed and run in-process."""

import tempfile
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from epipole.flows.nightly import nightly
from epipole.flows.prefect.defaults import embedded_prefect, quiet_console
from epipole.flows.simulate import simulate
from epipole.schemas.scene import validate_scene

SCENE = Path(__file__).parents[2] / "io/simulation/built_in/four_sensor_geo.toml"


@contextmanager
def runs() -> Iterator[Callable[..., tuple[Any, Path, Path]]]:
    """Yield a function that simulates a changed scene and runs it: summary, dataset and log."""
    quiet_console()
    with embedded_prefect(), tempfile.TemporaryDirectory() as folder:
        count = 0

        def run(change: Callable[[dict[str, Any]], None], **settings: Any) -> Any:
            nonlocal count
            count += 1
            scene = tomllib.loads(SCENE.read_text())
            change(scene)
            log, out = Path(folder) / f"{count}.mcap", Path(folder) / f"out{count}"
            simulate(validate_scene(scene, "benchmark"), log)
            return nightly([str(log)], str(out), settings), out, log

        yield run
