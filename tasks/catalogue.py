"""The deep star catalogue: Gaia's stars with Hipparcos' motions, as a labelled table.

A plain function, not a Prefect task, because a catalogue is built once, by hand.
"""

import numpy as np
import pyarrow as pa

from epipole.io.catalogues.gaia import GAIA_EPOCH, NAME, GaiaStars, gaia_source, read_gaia
from epipole.io.catalogues.hipparcos import read_hipparcos
from epipole.schemas.bridge import array, table
from epipole.schemas.star_lists import (
    STAR_CATALOGUE,
    UNKNOWN_MOTION_MAS_YR,
    CatalogueLabel,
    label_of,
    labelled,
)
from epipole.tasks.algorithms.geometry.directions import unit_from_radec
from epipole.tasks.algorithms.star_catalogue import (
    johnson_v_of_gaia,
    join,
    joined_magnitude,
    propagate_positions,
)

# The errors of Gaia DR3 are about 0.02 mas, and below this value for all but a few bright stars.
GAIA_SIGMA_MAS = 1.0


def build_deep_catalogue() -> pa.Table:
    """Return Gaia DR3's stars to G 10 at 2016.0, with motions, as a table STAR_CATALOGUE.

    Gaia's stars have Gaia's positions and ids. A star that is in both catalogues has the motion and
    parallax of Hipparcos. For the others both are zero, with the sigma UNKNOWN_MOTION_MAS_YR. Stars
    that only Hipparcos has, such as the brightest, are moved to 2016.0. Their id is minus the
    Hipparcos number.

    Raises
    ------
    CatalogueError
        Where a data package is missing or damaged.
    """
    gaia, hipparcos = read_gaia(), _at_gaia_epoch(read_hipparcos())
    from_gaia = gaia.star_id > 0
    gaia = GaiaStars(*[column[from_gaia] for column in gaia])  # type: ignore[arg-type]
    v = johnson_v_of_gaia(gaia.g, gaia.bp, gaia.rp)
    joined = join(
        unit_from_radec(np.radians(gaia.ra_deg), np.radians(gaia.dec_deg)),
        v,
        unit_from_radec(*(np.radians(array(hipparcos, c)) for c in ("ra_deg", "dec_deg"))),
        array(hipparcos, "magnitude"),
    )
    known = joined.hipparcos_of >= 0
    of_hipparcos = hipparcos.take(np.maximum(joined.hipparcos_of, 0))
    columns = {
        name: np.where(known, array(of_hipparcos, name), otherwise)
        for name, otherwise in (
            ("pm_ra_mas_yr", 0.0),
            ("pm_dec_mas_yr", 0.0),
            ("parallax_mas", 0.0),
            ("pm_sigma_mas_yr", UNKNOWN_MOTION_MAS_YR),
            ("variable", False),
        )
    }
    columns |= {
        "star_id": gaia.star_id,
        "ra_deg": gaia.ra_deg,
        "dec_deg": gaia.dec_deg,
        "sigma_mas": np.full(len(v), GAIA_SIGMA_MAS),
        "magnitude": np.where(known, joined_magnitude(v, array(of_hipparcos, "magnitude")), v),
    }
    added = hipparcos.take(joined.missing)
    added = added.set_column(0, STAR_CATALOGUE.field("star_id"), pa.array(-array(added, "star_id")))
    source = (
        f"{gaia_source()}; motions, parallaxes and stars with negative ids: "
        + label_of(hipparcos.schema).source
    )
    both = pa.concat_tables([table(STAR_CATALOGUE, columns), added]).combine_chunks()
    return labelled(both, CatalogueLabel(NAME, GAIA_EPOCH, source))


def _at_gaia_epoch(hipparcos: pa.Table) -> pa.Table:
    """Return Hipparcos' stars at Gaia's epoch, with the errors of their positions there."""
    label = label_of(hipparcos.schema)
    years = GAIA_EPOCH - label.epoch
    ra, dec, pm_ra, pm_dec = propagate_positions(
        np.radians(array(hipparcos, "ra_deg")),
        np.radians(array(hipparcos, "dec_deg")),
        array(hipparcos, "pm_ra_mas_yr"),
        array(hipparcos, "pm_dec_mas_yr"),
        years,
    )
    columns = {name: hipparcos[name] for name in STAR_CATALOGUE.names} | {
        "ra_deg": np.degrees(ra),
        "dec_deg": np.degrees(dec),
        "pm_ra_mas_yr": pm_ra,
        "pm_dec_mas_yr": pm_dec,
        "sigma_mas": np.hypot(
            array(hipparcos, "sigma_mas"), array(hipparcos, "pm_sigma_mas_yr") * years
        ),
    }
    return labelled(table(STAR_CATALOGUE, columns), label._replace(epoch=GAIA_EPOCH))
