"""The orbits of a scene: what their parameters are, and what must hold of them."""

from typing import Literal, Self

from pydantic import Field, model_validator

from epipole.schemas.settings import Group

Vector = tuple[float, float, float]


class Orbit(Group):
    """An orbit about the Earth.

    By elements or by a position at the start of the scene, random, or of real satellites: by SGP4
    from a file of published element sets.
    """

    a_km: float | None = Field(None, gt=6378.0, description="Semi-major axis.")
    e: float = Field(0.0, ge=0, lt=1, description="Eccentricity.")
    i_deg: float = Field(0.0, ge=0, le=180, description="Inclination.")
    raan_deg: float = Field(0.0, description="Right ascension of the ascending node.")
    argp_deg: float = Field(0.0, description="Argument of perigee.")
    mean_anomaly_deg: float | None = Field(None, description="Mean anomaly at the start.")
    true_anomaly_deg: float | None = Field(None, description="The true anomaly instead.")
    position_km: Vector | None = Field(None, description="GCRF position at the start.")
    velocity_km_s: Vector | None = Field(
        None, description="GCRF velocity there. Default: a circular orbit eastward."
    )
    random: Literal["leo", "meo", "geo"] | None = Field(
        None, description="A random orbit of this kind."
    )

    elements: str | None = Field(
        None,
        min_length=1,
        description="A file of element sets: two-line elements, or OMM in JSON, CSV or XML. A "
        "relative path starts at the folder of the scene file, or is a file of the package.",
    )
    satellites: list[str | int] = Field(
        [], description="Names or catalogue numbers to take from the file. Default: all."
    )

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        ways = (self.a_km, self.position_km, self.random, self.elements)
        if sum(way is not None for way in ways) != 1:
            raise ValueError("an orbit takes one of a_km, position_km, random and elements")
        if self.satellites and self.elements is None:
            raise ValueError("satellites goes with elements")
        if self.elements is not None:
            for name in sorted(self.model_fields_set - {"elements", "satellites"}):
                raise ValueError(f"{name} does not go with elements")
        if self.mean_anomaly_deg is not None and self.true_anomaly_deg is not None:
            raise ValueError("an orbit takes mean_anomaly_deg or true_anomaly_deg, not both")
        if self.position_km is not None and not any(self.position_km[:2]):
            raise ValueError("position_km lies on the Earth's axis")
        if self.velocity_km_s is not None and self.position_km is None:
            raise ValueError("velocity_km_s goes with position_km")
        if self.a_km is not None and self.a_km * (1 - self.e) < 6378.0:
            raise ValueError("the orbit's perigee lies below the ground")
        return self
