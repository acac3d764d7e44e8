"""`epipole deploy-files`: what an operator needs to run it every night."""

import os
from pathlib import Path
from typing import Annotated

import typer

from epipole.flows.command_line.printing import print_lines
from epipole.flows.prefect.server_process import new_secret
from epipole.schemas.errors import EpipoleError

# Each file, and what it is for.
FILES = {
    "prefect.env": "settings of Prefect with a new secret; readable by you only",
    "prefect.yaml": "the deployment, for `prefect deploy --all`",
    "automations.yaml": "lost, failed and late runs: for `prefect automation create --from-file`",
    "epipole-server.service": "Prefect's server as a systemd unit",
    "epipole-worker.service": "a worker as a systemd unit",
    "Containerfile": "a worker in a container",
}
_SECRET = "@SECRET@"


def deploy_files(
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder to write to.")] = Path("."),
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there.")] = False,
) -> None:
    """Write the files of a nightly deployment: Prefect, systemd, container.

    docs/operations.md goes through them. A file that is there is not replaced. prefect.env has the
    secret that Prefect's server asks for; each call makes another one.
    """
    from importlib.resources import files

    there = [name for name in FILES if (out / name).exists()]
    if there and not force:
        raise EpipoleError(
            f"{out}: has {', '.join(there)}; nothing was written: give another folder, or --force"
        )
    source = files("epipole.flows.prefect") / "deploy_files"
    secret = new_secret()
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name in FILES:
            _write(out / name, (source / name).read_text(encoding="utf-8"), secret)
    except OSError as error:
        raise EpipoleError(f"{out}: cannot be written: {error.strerror}; give another") from error
    print_lines(f"{out / name!s:<26}  {use}" for name, use in FILES.items())


def _write(file: Path, text: str, secret: str) -> None:
    """Write a new file; one with the secret is readable by its owner only from the start."""
    file.unlink(missing_ok=True)
    mode = 0o600 if _SECRET in text else 0o666  # of which the user's umask takes its part
    # Not through a link that somebody has put there meanwhile.
    new = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with open(new, "w", encoding="utf-8") as opened:
        opened.write(text.replace(_SECRET, secret))
