"""`epipole deploy-files`: what an operator needs to run it every night."""

from pathlib import Path
from typing import Annotated

import typer

from epipole.flows.command_line.printing import print_lines
from epipole.schemas.errors import EpipoleError

# Each file, and what it is for.
FILES = {
    "prefect.yaml": "the deployment, for `prefect deploy --all`",
    "automations.yaml": "lost, failed and late runs, for `prefect automation create --from-file`",
    "epipole-server.service": "Prefect's server as a systemd unit",
    "epipole-worker.service": "a worker as a systemd unit",
    "Containerfile": "a worker in a container",
}


def deploy_files(
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder to write to.")] = Path("."),
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there.")] = False,
) -> None:
    """Write the files of a nightly deployment: Prefect, systemd, container.

    docs/operations.md goes through them. A file that is there is not replaced.
    """
    from importlib.resources import files

    there = [name for name in FILES if (out / name).exists()]
    if there and not force:
        raise EpipoleError(
            f"{out}: has {', '.join(there)}; nothing was written: give another folder, or --force"
        )
    source = files("epipole.flows.prefect") / "deploy_files"
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name in FILES:
            (out / name).write_text((source / name).read_text(encoding="utf-8"), encoding="utf-8")
    except OSError as error:
        raise EpipoleError(f"{out}: cannot be written: {error.strerror}; give another") from error
    print_lines(f"{out / name!s:<26}  {use}" for name, use in FILES.items())
