"""`epipole catalog build`: star catalogues."""

from pathlib import Path
from typing import Annotated

import typer

from epipole.flows.command_line.options import AsJson
from epipole.flows.command_line.printing import help_text, print_json, print_lines

app = typer.Typer(help="Build a star catalogue for star identification.", no_args_is_help=True)


@app.callback()
def _catalog() -> None:
    """Make `build` a subcommand, though it is the only one."""


def build(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE", help="hipparcos, deep, or a CSV or Parquet file of stars."
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="Parquet file to write.")],
    epoch: Annotated[
        float | None,
        typer.Option(
            metavar="YEAR", help="Julian year of the positions in the file, such as 2016.0."
        ),
    ] = None,
    name: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Name of the catalogue; default: the name of the file."),
    ] = None,
    magnitude_limit: Annotated[
        float | None, typer.Option("--limit", metavar="MAG", help="Leave fainter stars out.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a star catalogue for the setting identification.catalogue.

    hipparcos: what a run uses by default, complete to magnitude 7.3

    deep: Gaia DR3 to G 10 with the motions of Hipparcos, for fields below 5 degrees.
    Needs the extra "deep" of epipole. Its data are share-alike (CC BY-SA 3.0).

    A file needs the columns star_id (whole numbers), ra_deg, dec_deg (ICRS) and
    magnitude (V). It may have pm_ra_mas_yr (times cos dec), pm_dec_mas_yr,
    parallax_mas, sigma_mas, pm_sigma_mas_yr (1-sigma per axis) and variable
    (true or false). Invalid rows are reported by number, from 1 without the header.
    """
    from epipole.flows.catalogue import build_catalogue

    built = build_catalogue(source, out, epoch, name, magnitude_limit)
    if as_json:
        print_json(built.as_dict())
    else:
        print_lines(built.lines())


app.command(help=help_text(build))(build)
