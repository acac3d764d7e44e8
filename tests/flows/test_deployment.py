"""The deployment for real: a server, a work pool, a worker, a night; and what kills them."""

import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
import yaml
from scenes.dataset_tables import contents, published
from scenes.prefect_server import EPIPOLE, POOL, Prefect, deploy_files, serving, wait_for

from epipole.io.logs.writer import LogWriter

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
NIGHT = "2019-04-01"
CAMERA = dict.fromkeys(["k1", "k2", "p1", "p2", "k3"], 0.0) | {
    "width": 512, "height": 512, "fx_px": 1e3, "fy_px": 1e3, "cx_px": 255.5, "cy_px": 255.5
}  # fmt: skip


class Deployed:
    """The deployment `nightly/nightly` on a server of its own."""

    def __init__(self, prefect: Prefect) -> None:
        self.prefect = prefect
        self.out = prefect.folder / "dataset"
        self.worker = prefect.start_worker()

    def ask(self, **parameters: object) -> str:
        """Ask for a run, as the page does; return its id."""
        deployment = self.prefect.get("deployments/name/nightly/nightly")["id"]
        asked = {"parameters": parameters, "state": {"type": "SCHEDULED"}}
        return self.prefect.post(f"deployments/{deployment}/create_flow_run", asked)["id"]

    def in_the_middle(self, **parameters: object) -> tuple[str, list[int]]:
        """Ask for a run; return its id and processes once some of its tasks are done."""
        run_id = self.ask(**parameters)
        of_run = {"id": {"any_": [run_id]}}
        done = {"state": {"type": {"any_": ["COMPLETED"]}}}
        wait_for(
            lambda: self.prefect.find("task_runs", flow_runs=of_run, task_runs=done),
            "the first task to end",
        )
        processes = self.prefect.flow_processes(self.worker)
        assert processes
        return run_id, processes

    def ends_as(self, run_id: str, state: str) -> dict:
        wait_for(lambda: self.prefect.run(run_id)["state_type"] == state, f"the run to be {state}")
        return self.prefect.run(run_id)


@pytest.fixture(scope="module")
def deployed(tmp_path_factory, night_log) -> Iterator[Deployed]:
    """Go through the commands of docs/operations.md, with two lines of prefect.yaml changed."""
    folder = tmp_path_factory.mktemp("deployed")
    (folder / "logs").mkdir()
    (folder / "logs" / night_log.name).symlink_to(night_log)
    with LogWriter(folder / "logs" / "another.mcap") as log:  # of another night
        time_ns = 1_554_000_000 * 10**9
        log.camera("a", time_ns, CAMERA)
        log.frame("a", time_ns, frame_number=0, exposure_s=0.1, x_px=[], y_px=[])
    settings = deploy_files(folder, folder / "logs", folder / "dataset")
    deployment = yaml.safe_load((folder / "prefect.yaml").read_text())["deployments"][0]
    assert deployment["work_pool"]["name"] == POOL
    with serving(folder, **settings) as prefect:
        made = prefect.command("work-pool", "create", POOL, "--type", "process")
        assert made.returncode == 0, made.stderr
        there = prefect.command("deploy", "--all")
        assert there.returncode == 0, there.stdout + there.stderr
        assert "'nightly/nightly' successfully created" in " ".join(there.stdout.split())
        yield Deployed(prefect)


def test_the_commands_that_are_run_here_stand_on_the_page_of_operations():
    page = (ROOT / "docs" / "operations.md").read_text()
    for command in (
        "epipole deploy-files --out .",
        "set -a; . ./prefect.env; set +a",
        "prefect server start",
        f"prefect work-pool create {POOL} --type process",
        "prefect deploy --all",
        "prefect automation create --from-file automations.yaml",
        f"prefect worker start --pool {POOL}",
        f"prefect deployment run 'nightly/nightly' --param night={NIGHT} --watch",
    ):
        assert f"\n{command}" in page, command


def test_the_server_answers_only_who_has_the_secret(deployed):
    url = f"{deployed.prefect.url}/flow_runs/filter"
    for told in (None, ("epipole", "@SECRET@"), ("admin", "pass")):
        assert httpx.post(url, json={}, auth=told).status_code == 401
    secret = deployed.prefect.environment["PREFECT_API_AUTH_STRING"].split(":")[1].rstrip("-")
    for file in ("worker.txt", "server.txt"):
        said = (deployed.prefect.folder / file).read_text()
        assert not [k for k in range(len(secret) - 8) if secret[k : k + 8] in said]


def test_a_run_from_the_command_line_without_the_secret_is_one_line(deployed, night_log, tmp_path):
    kept = {name: value for name, value in os.environ.items() if "PREFECT" not in name}
    ran = subprocess.run(
        [*EPIPOLE, "run", str(night_log), "--out", str(tmp_path / "out")],
        env=kept | {"PREFECT_API_URL": deployed.prefect.url}, capture_output=True, text=True,
    )  # fmt: skip
    assert ran.returncode == 1
    assert "asks for a secret; set PREFECT_API_AUTH_STRING to it" in ran.stderr
    assert "Traceback" not in ran.stderr


def test_runs_are_scheduled_for_six_in_the_morning(deployed):
    def scheduled() -> list[dict]:
        return deployed.prefect.find(
            "flow_runs", flow_runs={"state": {"type": {"any_": ["SCHEDULED"]}}}
        )

    runs = wait_for(scheduled, "the scheduler to make runs")
    assert {run["expected_start_time"][10:19] for run in runs} == {"T06:00:00"}
    assert {run["parameters"]["night"] for run in runs} == {"yesterday"}


def test_a_killed_run_leaves_nothing_and_the_next_makes_the_night(deployed, night_dataset):
    run_id, processes = deployed.in_the_middle(night=NIGHT, again=True)
    for pid in processes:
        os.kill(pid, signal.SIGKILL)
    deployed.ends_as(run_id, "CRASHED")
    assert not published(deployed.out)

    ran = deployed.prefect.command(
        "deployment", "run", "nightly/nightly", "--param", f"night={NIGHT}", "--watch"
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "finished successfully" in ran.stdout
    assert published(deployed.out) == published(night_dataset)


def test_the_page_shows_named_task_runs_logs_and_artifacts(deployed):
    prefect = deployed.prefect
    completed = {"state": {"type": {"any_": ["COMPLETED"]}}}
    (run,) = prefect.find("flow_runs", flow_runs=completed)
    assert run["name"] == f"night {NIGHT}"
    of_run = {"flow_runs": {"id": {"any_": [run["id"]]}}}
    tasks = {task["name"] for task in prefect.find("task_runs", **of_run)}
    assert {f"identify sat{k} 04:00-04:30" for k in (1, 2, 3, 4)} <= tasks
    lines = [
        line["message"]
        for line in prefect.find("logs", logs={"flow_run_id": {"any_": [run["id"]]}})
    ]
    assert f"found 1 log of {NIGHT}" in lines
    assert any(line.startswith("identified 240 of 240 frames by") for line in lines)
    shown = {artifact["key"]: artifact["data"] for artifact in prefect.find("artifacts", **of_run)}
    assert set(shown) == {"progress", "night", "sensors"}
    assert shown["progress"] == 100
    assert "| objects | 9 |" in shown["night"]


def test_a_wrong_parameter_is_refused_before_a_run_is_made(deployed):
    before = len(deployed.prefect.find("flow_runs"))
    asked = deployed.prefect.command(
        "deployment", "run", "nightly/nightly", "--param", "night=tonight"
    )
    assert asked.returncode != 0
    said = " ".join((asked.stdout + asked.stderr).split())
    assert "field 'night'. Failure reason: 'tonight' does not match" in said
    assert len(deployed.prefect.find("flow_runs")) == before


def test_a_night_without_logs_has_not_failed_and_a_line_says_so(deployed):
    before = contents(deployed.out)
    run_id = deployed.ask(night="2019-05-01")
    run = deployed.ends_as(run_id, "COMPLETED")
    assert run["state"]["message"].startswith("no frames: ")
    assert run["state"]["message"].endswith(
        "logs: no frames on 2019-05-01 in these logs; they have 2019-03-31 to 2019-04-01"
    )
    assert run["run_count"] == 1
    assert contents(deployed.out) == before


def test_a_killed_worker_leaves_the_dataset_and_the_next_one_goes_on(deployed, night_dataset):
    before = published(deployed.out)
    assert before == published(night_dataset)
    name = automation_for_lost_runs(deployed.prefect)
    run_id, processes = deployed.in_the_middle(night=NIGHT, again=True)
    for pid in (deployed.worker.pid, *processes):
        os.kill(pid, signal.SIGKILL)
    deployed.worker.wait(timeout=30)
    assert published(deployed.out) == before
    deployed.worker = deployed.prefect.start_worker()
    next_id = deployed.ask(night=NIGHT, again=True)
    wait_for(
        lambda: deployed.prefect.run(next_id)["state_name"] == "AwaitingConcurrencySlot",
        "the next run to wait for the place of the dead one",
    )
    lost = deployed.ends_as(run_id, "CRASHED")
    assert lost["state"]["message"].startswith("No sign of life for ")
    deployed.prefect.command("--no-prompt", "automation", "delete", name)
    deployed.ends_as(next_id, "COMPLETED")
    assert published(deployed.out) == before
    assert published(deployed.out) == contents(deployed.out)  # nothing of the dead run


def automation_for_lost_runs(prefect: Prefect) -> str:
    """Make the first of the automations that come with epipole, quicker; return its name."""
    text = (prefect.folder / "automations.yaml").read_text()
    lost = yaml.safe_load(text)["automations"][0]
    assert lost["trigger"]["within"] == 180
    lost["trigger"]["within"] = 40  # a heartbeat comes every 30 s, the shortest that Prefect has
    file = prefect.folder / "automation.yaml"
    file.write_text(yaml.safe_dump(lost))
    made = prefect.command("automation", "create", "--from-file", str(file))
    assert made.returncode == 0, made.stdout + made.stderr
    return str(lost["name"])


def test_a_run_from_the_command_line_goes_to_the_server_of_the_users_profile(
    deployed, night_log, tmp_path
):
    (tmp_path / "profiles.toml").write_text(
        f'active = "ours"\n[profiles.ours]\nPREFECT_API_URL = "{deployed.prefect.url}"\n'
    )
    kept = {name: value for name, value in os.environ.items() if "PREFECT" not in name}
    secret = {k: v for k, v in deployed.prefect.environment.items() if k.endswith("AUTH_STRING")}
    ran = subprocess.run(
        [*EPIPOLE, "run", str(night_log), "--out", str(tmp_path / "out")],
        env=kept | secret | {"PREFECT_HOME": str(tmp_path)},
        cwd=tmp_path, capture_output=True, text=True,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    named = {"name": {"any_": [f"all nights of {night_log.name}"]}}
    (run,) = deployed.prefect.find("flow_runs", flow_runs=named)
    assert run["state_type"] == "COMPLETED"
    assert not list(tmp_path.glob("*.db*"))  # no embedded server's database


def test_a_range_of_nights_is_made_by_the_deployment_without_a_schedule(deployed):
    asked = f"2019-03-31/{NIGHT}"
    ran = deployed.prefect.command(
        "deployment", "run", "nightly/backfill", "--param", f"night={asked}", "--watch"
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    nights = {path.name for path in deployed.out.glob("night=*")}
    assert nights == {"night=2019-03-31", f"night={NIGHT}"}
    (run,) = deployed.prefect.find("flow_runs", flow_runs={"name": {"any_": [f"night {asked}"]}})
    assert "2019-03-31 made: " in run["state"]["message"]
